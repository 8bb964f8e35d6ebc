"""A node that publishes as rmw_zenoh does: its keys, liveliness tokens, caches and attachments.

The forms are those of rmw_zenoh's design document and sources (`rmw_publisher_data.cpp`,
`liveliness_utils.cpp`, `attachment_helpers.cpp`).
"""

import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
from zenoh.ext import CacheConfig, declare_advanced_publisher

from tests.support.ros2dds import KINDS, LATCHED
from tests.support.ros_messages import TYPES

_GIDS = itertools.count(1)


def dds_type(type_name: str) -> str:
    """``std_msgs::msg::dds_::String_`` of ``std_msgs/msg/String``."""
    package, _, name = type_name.split("/")
    return f"{package}::msg::dds_::{name}_"


def type_hash(type_name: str) -> str:
    """The hash that ROS gives the type, by rosbags."""
    return TYPES._store.hash_rihs01(type_name)


def attachment(number: int, gid: bytes, *, labelled: bool = False) -> bytes:
    """The attachment of a message, with the names of its fields as older versions send it."""
    values = number.to_bytes(8, "little"), bytes(8), bytes([len(gid)]) + gid
    if not labelled:
        return b"".join(values)
    names = b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid"
    return b"".join(part for pair in zip(names, values, strict=True) for part in pair)


class Node:
    """A node's session and its publishers, in one domain."""

    def __init__(self, session: Any, domain: int = 0, namespace: str = "") -> None:
        self.session = session
        self._domain = domain
        self._namespace = namespace
        self._publishers: dict[str, Any] = {}
        self._tokens: list[Any] = []
        self._gids: dict[str, bytes] = {}
        self.numbers: dict[str, int] = {}

    def name(self, topic: str) -> str:
        """The full name of a topic."""
        return f"{self._namespace}{topic}"

    def key(self, topic: str, type_name: str, hash_: str | None = None) -> str:
        """The key of a topic's messages."""
        hashed = hash_ or type_hash(type_name)
        return f"{self._domain}{self.name(topic)}/{dds_type(type_name)}/{hashed}"

    def advertise(self, topic: str, type_name: str, hash_: str | None = None) -> None:
        """Declare publisher and token of a topic; a latched one keeps its last message."""
        latched = topic in LATCHED
        self._gids[topic] = next(_GIDS).to_bytes(16, "big")
        self.numbers[topic] = 0
        self._publishers[topic] = declare_advanced_publisher(
            self.session,
            self.key(topic, type_name, hash_),
            cache=CacheConfig(max_samples=1) if latched else None,
            publisher_detection=latched,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )
        qos = ":1:,1:,:,:,," if latched else "::,10:,:,:,,"
        token = (
            f"@ros2_lv/{self._domain}/{self.session.zid()}/0/{len(self._tokens) + 10}/MP/%/"
            f"{self._namespace.replace('/', '%') or '%'}/robot/"
            f"{self.name(topic).replace('/', '%')}/{dds_type(type_name)}/"
            f"{hash_ or type_hash(type_name)}/{qos}"
        )
        self._tokens.append(self.session.liveliness().declare_token(token))

    def advertise_all(self) -> None:
        """Declare the publishers of all topics of a drive."""
        for topic, type_name in KINDS.items():
            self.advertise(topic, type_name)

    def send(self, topic: str, message: Any, *, labelled: bool = False) -> bytes:
        """Publish a message of rosbags; returns its CDR."""
        payload = TYPES.encode(message, message.__msgtype__)
        self.numbers[topic] += 1
        attached = attachment(self.numbers[topic], self._gids[topic], labelled=labelled)
        self._publishers[topic].put(payload, attachment=attached)
        return payload

    def lose(self, topic: str, count: int) -> None:
        """Give numbers to messages that never arrive."""
        self.numbers[topic] += count


@contextmanager
def node(connect: str, domain: int = 0, namespace: str = "") -> Iterator[Node]:
    """A node connected to a router."""
    config = zenoh.Config()
    for path, value in {
        "mode": "client",
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "connect/endpoints": [connect],
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield Node(session, domain, namespace)
