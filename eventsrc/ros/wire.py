"""How messages of ROS 2 come over Zenoh: keys, tokens, caches and sequence numbers.

In a log a topic has the name that it has in ROS, ``/bot1/tf``. A payload is the message in CDR,
with the four bytes of encapsulation before it, in both ways:

* `BridgeWire`, a zenoh-bridge-ros2dds. A message of ``/tf`` comes under the key ``tf``, or
  ``bot1/tf`` from a bridge whose namespace is ``/bot1``. Its type is in a liveliness token of the
  bridge, with ``§`` for each slash of key and type::

      @/<zenoh id>/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/<quality of service>
      @ros2_lv/<zenoh id>/MP/…                                     (older bridges)

  The last messages of a transient-local topic (``/tf_static``) are in a cache::

      bot1/tf_static/@adv/pub/**
      @/<zenoh id>/@ros2_pub_cache/bot1/tf_static                  (older bridges)

* `RmwWire`, nodes whose middleware is rmw_zenoh. The key has domain, topic, type and the hash of
  the type's definition; a publisher's token has the topic with ``%`` for each slash::

      0/bot1/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_…
      @ros2_lv/0/<zenoh id>/<node>/<publisher>/MP/<enclave>/<namespace>/<node name>/%bot1%tf/<type>/
          <hash>/<quality of service>

  Caches are ``<key>/@adv/pub/**``, of older versions ``<zenoh id>/<key>``. Each message has an
  attachment: its number, the time, and the publisher's id, which is new when its node starts again.
  A service is a queryable of such a key; a request has an attachment of its client's, the reply the
  same with its own time.
"""

import re
from collections.abc import Callable
from typing import Final, NamedTuple, Protocol

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible

MAX_TOKEN: Final = 4_096
SLASH: Final = "§"
_ANY_KEY: Final = "?_anyke"
"""The parameter of a query that accepts answers under other keys than its own."""
_BRIDGE_TOKEN: Final = re.compile(r"(?:@/[^/]+/@ros2_lv|@ros2_lv/[^/]+)/MP/([^/]+)/([^/]+)(?:/.*)?")
_RMW_TOKEN: Final = re.compile(
    r"@ros2_lv/(\d+)/[^/]+/[^/]+/[^/]+/MP/([^/]+)/[^/]+/[^/]+/([^/]+)/([^/]+)/([^/]+)/([^/]+)"
)
_TYPE: Final = re.compile(r"[A-Za-z]\w{0,99}/msg/[A-Za-z]\w{0,99}", re.ASCII)
_DDS_TYPE: Final = re.compile(r"([A-Za-z]\w{0,99})::msg::dds_::([A-Za-z]\w{0,99})_", re.ASCII)
_NAME: Final = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_MAX_NAME: Final = 500
_TRANSIENT_LOCAL: Final = "1"
_OWN_ENCLAVE: Final = "%mapfold"
"""The security enclave in the tokens of our own nodes, by which they are known under any name."""
_LABELLED: Final = b"\x0fsequence_number"
"""The start of attachments that name their fields, which older versions of rmw_zenoh send."""
_FIELDS: Final = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid")


class KeyParts(NamedTuple):
    """What a message's key says: topic, type and hash of the type's definition; None if it does
    not."""

    topic: str
    type_name: str | None = None
    type_hash: str | None = None


class PublisherToken(NamedTuple):
    """What a publisher's liveliness token says; ``is_latched`` if it keeps messages for late
    subscribers, ``is_own`` if it is that of a `RmwNode`."""

    topic: str
    type_name: str
    is_latched: bool = False
    is_own: bool = False


class Wire(Protocol):
    """Keys, tokens and caches of one of the two ways."""

    @property
    def read_attachment(self) -> Callable[[bytes], tuple[str, int] | None] | None:
        """Gives the publisher and the number of the message with an attachment, None if it has
        neither. None where numbers are those of Zenoh's advanced publishers."""

    def key(self, topic: str) -> str:
        """The key expression of a topic's messages."""

    def read_key(self, key: str) -> KeyParts | None:
        """The parts of a message's key; None if it is that of no topic."""

    def token_selectors(self, topic: str) -> tuple[str, ...]:
        """The key expressions of the tokens of a topic's publishers."""

    def read_token(self, token: str) -> PublisherToken | None:
        """The content of a token; None if it is that of no publisher of messages."""

    def cache_selectors(self, topic: str) -> tuple[str, ...]:
        """The queries for the messages that publishers of a topic keep for late subscribers."""


class BridgeWire:
    """Messages from a zenoh-bridge-ros2dds."""

    read_attachment = None

    def key(self, topic: str) -> str:
        """`Wire.key`."""
        return topic.removeprefix("/")

    def read_key(self, key: str) -> KeyParts | None:
        """`Wire.read_key`."""
        return KeyParts(f"/{key}")

    def token_selectors(self, topic: str) -> tuple[str, ...]:
        """`Wire.token_selectors`."""
        escaped = self.key(topic).replace("/", SLASH)
        return f"@/*/@ros2_lv/MP/{escaped}/**", f"@ros2_lv/*/MP/{escaped}/**"

    def read_token(self, token: str) -> PublisherToken | None:
        """`Wire.read_token`."""
        found = _BRIDGE_TOKEN.fullmatch(token) if len(token) <= MAX_TOKEN else None
        if found is None:
            return None
        key, type_name = (part.replace(SLASH, "/") for part in found.groups())
        return PublisherToken(f"/{key}", type_name) if _TYPE.fullmatch(type_name) else None

    def cache_selectors(self, topic: str) -> tuple[str, ...]:
        """`Wire.cache_selectors`."""
        key = self.key(topic)
        return f"{key}/@adv/pub/**{_ANY_KEY}", f"@/*/@ros2_pub_cache/{key}{_ANY_KEY}"


class RmwWire:
    """Messages from nodes over rmw_zenoh, in one domain."""

    def __init__(self, domain: int = 0) -> None:
        self.domain = domain

    def key(self, topic: str) -> str:
        """`Wire.key`."""
        return f"{self.domain}{topic}/*/*"

    def read_key(self, key: str) -> KeyParts | None:
        """`Wire.read_key`."""
        if len(key) > MAX_TOKEN:
            return None
        start, _, type_hash = key.rpartition("/")
        start, _, dds_type = start.rpartition("/")
        domain, _, name = start.partition("/")
        type_name = _from_dds(dds_type)
        if domain != str(self.domain) or type_name is None or not _is_name(name):
            return None
        return KeyParts(f"/{name}", type_name, type_hash)

    def all_tokens(self) -> str:
        """The key expression of the tokens of all publishers."""
        return self._tokens("*")

    def token_selectors(self, topic: str) -> tuple[str, ...]:
        """`Wire.token_selectors`."""
        return (self._tokens(topic.replace("/", "%")),)

    def _tokens(self, topic: str) -> str:
        return f"@ros2_lv/{self.domain}/*/*/*/MP/*/*/*/{topic}/*/*/*"

    def read_token(self, token: str) -> PublisherToken | None:
        """`Wire.read_token`."""
        found = _RMW_TOKEN.fullmatch(token) if len(token) <= MAX_TOKEN else None
        if found is None or found[1] != str(self.domain):
            return None
        topic, type_name = found[3].replace("%", "/"), _from_dds(found[4])
        if type_name is None or not topic.startswith("/") or not _is_name(topic[1:]):
            return None
        _, _, after_reliability = found[6].partition(":")
        is_latched = after_reliability.partition(":")[0] == _TRANSIENT_LOCAL
        return PublisherToken(topic, type_name, is_latched, found[2] == _OWN_ENCLAVE)

    def cache_selectors(self, topic: str) -> tuple[str, ...]:
        """`Wire.cache_selectors`."""
        key = self.key(topic)
        return f"{key}/@adv/pub/**{_ANY_KEY}", f"*/{key}{_ANY_KEY}"

    def read_attachment(self, attachment: bytes) -> tuple[str, int] | None:
        """`Wire.read_attachment`."""
        parts = _labelled_parts(attachment) if attachment.startswith(_LABELLED) else attachment
        if len(parts) < 17 or len(parts) != 17 + parts[16]:
            return None
        return parts[17:].hex(), int.from_bytes(parts[:8], "little")


def _labelled_parts(attachment: bytes) -> bytes:
    """An attachment that names its fields, without the names; empty if it is none."""
    rest, parts = attachment, b""
    for name, size in zip(_FIELDS, (8, 8, None), strict=True):
        if not rest.startswith(name):
            return b""
        rest = rest[len(name) :]
        parts += rest[:size]
        rest = rest[size:] if size else b""
    return parts


class RmwNode(NamedTuple):
    """A node of our own over rmw_zenoh, in the Zenoh session ``session_id``: its tokens and keys.
    ``namespace`` is ``/bot1``, or empty for none."""

    domain: int
    session_id: str
    namespace: str
    name: str

    def token(self) -> str:
        """The liveliness token of the node."""
        return self._tokens(0, "NN")

    def end_token(
        self, kind: str, number: int, topic: str, end: str, *, latched: bool = False
    ) -> str:
        """The liveliness token of its publisher (MP), subscription (MS) or service (SS) with a
        ``number`` of its own. ``end`` is `end_of_key`."""
        quality = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        return f"{self._tokens(number, kind)}/{topic.replace('/', '%')}/{end}/{quality}"

    def _tokens(self, number: int, kind: str) -> str:
        namespace = self.namespace.replace("/", "%") or "%"
        entity = f"@ros2_lv/{self.domain}/{self.session_id}/0/{number}/{kind}"
        return f"{entity}/{_OWN_ENCLAVE}/{namespace}/{self.name}"

    def key(self, topic: str, end: str) -> str:
        """The key of a topic's messages, or of a service's requests."""
        return f"{self.domain}{topic}/{end}"

    def cache(self, key: str, number: int) -> str:
        """The key under which late subscribers ask for a publisher's last message, and the token
        by which subscribers that are there already find it."""
        return f"{key}/@adv/pub/{self.session_id}/{number}/_"


def end_of_key(type_name: str, type_hash: str) -> str:
    """Type and hash as keys have them, of ``std_msgs/msg/String`` or ``std_srvs/srv/Trigger``."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_/{type_hash}"


def attachment(number: int, stamp_ns: int, publisher: bytes) -> bytes:
    """The attachment of a message: its number, the time, and the publisher's id."""
    sent = number.to_bytes(8, "little") + stamp_ns.to_bytes(8, "little", signed=True)
    return sent + bytes([len(publisher)]) + publisher


def reply_attachment(request: bytes, stamp_ns: int) -> bytes:
    """The attachment of the reply to a request with an attachment."""
    return request[:8] + stamp_ns.to_bytes(8, "little", signed=True) + request[16:]


def _from_dds(dds_type: str) -> str | None:
    """``tf2_msgs/msg/TFMessage`` of ``tf2_msgs::msg::dds_::TFMessage_``; None if it is no message's
    type."""
    found = _DDS_TYPE.fullmatch(dds_type)
    return None if found is None else f"{found[1]}/msg/{found[2]}"


def topic_of(namespace: str, topic: str, option: str) -> str:
    """The topic in a log of messages of the ROS topic ``topic`` from a bridge with ``namespace``.
    Raises MisuseError, which names ``option``, for an invalid name."""
    name = topic.removeprefix("/")
    if not _is_name(name):
        raise MisuseError(
            f"{option} {visible(repr(topic[:80]))} is no name of a ROS 2 topic; examples: "
            "/detections, /camera/detections"
        )
    bare = namespace.strip("/")
    if bare and not _is_name(bare):
        raise MisuseError(
            f"--namespace {visible(repr(namespace[:80]))} is no ROS 2 namespace; example: /bot1"
        )
    return f"/{bare}/{name}" if bare else f"/{name}"


def _is_name(text: str) -> bool:
    return len(text) <= _MAX_NAME and _NAME.fullmatch(text) is not None
