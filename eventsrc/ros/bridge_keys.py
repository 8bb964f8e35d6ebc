"""Keys, type tokens and caches of a zenoh-bridge-ros2dds.

A message of topic ``/tf`` comes under the key ``tf``, or ``bot1/tf`` from a bridge whose namespace
is ``/bot1``. Its payload is the message in CDR, with the four bytes of encapsulation before it. In
a log its topic is the key with a slash before it.

The type is in a liveliness token that the bridge declares for each topic that it publishes, with
``§`` for each slash of the key and of the type::

    @/<zenoh id>/@ros2_lv/MP/bot1§tf/tf2_msgs§msg§TFMessage/<quality of service>
    @ros2_lv/<zenoh id>/MP/…                                     (older bridges)

The last messages of a transient-local topic (``/tf_static``) are in a cache of the bridge, which
answers queries::

    bot1/tf_static/@adv/pub/**
    @/<zenoh id>/@ros2_pub_cache/bot1/tf_static  (older bridges)
"""

import re
from typing import Final

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible

SLASH: Final = "§"
MAX_TOKEN: Final = 4_096
_ANY_KEY: Final = "?_anyke"
"""The parameter of a query that accepts answers under other keys than its own."""
_TOKEN: Final = re.compile(r"(?:@/[^/]+/@ros2_lv|@ros2_lv/[^/]+)/MP/([^/]+)/([^/]+)(?:/.*)?")
_TYPE: Final = re.compile(r"[A-Za-z]\w{0,99}/msg/[A-Za-z]\w{0,99}", re.ASCII)
_NAME: Final = re.compile(r"[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_MAX_NAME: Final = 500


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


def key_of(topic: str) -> str:
    """The Zenoh key of a topic in a log."""
    return topic.removeprefix("/")


def token_selectors(key: str) -> tuple[str, ...]:
    """The key expressions that match the type tokens of a key, of current and older bridges."""
    escaped = key.replace("/", SLASH)
    return f"@/*/@ros2_lv/MP/{escaped}/**", f"@ros2_lv/*/MP/{escaped}/**"


def cache_selectors(key: str) -> tuple[str, ...]:
    """The queries for the cached messages of a key, of current and older bridges."""
    return f"{key}/@adv/pub/**{_ANY_KEY}", f"@/*/@ros2_pub_cache/{key}{_ANY_KEY}"


def type_of_token(token: str) -> tuple[str, str] | None:
    """Key and type (``tf2_msgs/msg/TFMessage``) of a token; None if it is no token of a topic."""
    found = _TOKEN.fullmatch(token) if len(token) <= MAX_TOKEN else None
    if found is None:
        return None
    key, type_name = (part.replace(SLASH, "/") for part in found.groups())
    return (key, type_name) if _TYPE.fullmatch(type_name) else None
