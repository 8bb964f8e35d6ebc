"""A publisher that speaks as a zenoh-bridge-ros2dds does: its keys, tokens, caches and CDR.

The form of tokens and caches is that of the bridge's sources (`liveliness_mgt.rs`,
`route_publisher.rs` of eclipse-zenoh/zenoh-plugin-ros2dds).
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

from tests.support.ros_messages import TYPES

QOS = ":1:0:0,10"
LATCHED_QOS = ":1:1:0,1"


class Bridge:
    """A bridge's session. ``old`` is one with older tokens and caches; a newer one publishes with
    sequence numbers and heartbeats."""

    def __init__(self, session: Any, namespace: str = "", *, old: bool = False) -> None:
        self.session = session
        self._old = old
        self._namespace = namespace.strip("/")
        self._publishers: dict[str, Any] = {}
        self._declared: list[Any] = []
        self._cache: dict[str, bytes] = {}

    def key(self, topic: str) -> str:
        """The key of a topic."""
        return f"{self._namespace}/{topic[1:]}".lstrip("/")

    def announce(self, topic: str, type_name: str, *, latched: bool = False) -> Any:
        """Declare the token of a topic."""
        zid = self.session.zid()
        prefix = f"@ros2_lv/{zid}/MP" if self._old else f"@/{zid}/@ros2_lv/MP"
        ke, typ = self.key(topic).replace("/", "§"), type_name.replace("/", "§")
        qos = LATCHED_QOS if latched else QOS
        token = self.session.liveliness().declare_token(f"{prefix}/{ke}/{typ}/{qos}")
        self._declared.append(token)
        return token

    def advertise(self, topic: str, *, latched: bool = False) -> None:
        """Declare the publisher of a topic; a latched one keeps its last message."""
        key = self.key(topic)
        if self._old:
            if latched:
                self._declared.append(
                    self.session.declare_queryable(
                        f"@/{self.session.zid()}/@ros2_pub_cache/{key}",
                        lambda query: query.reply(key, self._cache[key]),
                    )
                )
            self._publishers[topic] = self.session.declare_publisher(
                key, congestion_control=zenoh.CongestionControl.BLOCK
            )
            return
        self._publishers[topic] = declare_advanced_publisher(
            self.session,
            key,
            cache=CacheConfig(max_samples=1) if latched else None,
            sample_miss_detection=MissDetectionConfig(heartbeat=0.5),
            publisher_detection=True,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )

    def send(self, topic: str, message: Any) -> bytes:
        """Publish a message of rosbags; returns its CDR."""
        payload = TYPES.encode(message, message.__msgtype__)
        self.send_raw(topic, payload)
        return payload

    def send_raw(self, topic: str, payload: bytes) -> None:
        """Publish bytes."""
        self._cache[self.key(topic)] = payload
        self._publishers[topic].put(payload)


@contextmanager
def bridge(
    connect: str | None = None,
    *,
    mode: str = "client",
    listen: str | None = None,
    namespace: str = "",
    old: bool = False,
) -> Iterator[Bridge]:
    """A bridge connected to a router, or one that listens itself."""
    config = zenoh.Config()
    for path, value in {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,
        "connect/endpoints": [connect] if connect else [],
        "listen/endpoints": [listen] if listen else [],
    }.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config) as session:
        yield Bridge(session, namespace, old=old)
