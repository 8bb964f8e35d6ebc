"""A publisher that speaks as a zenoh-bridge-ros2dds does: its keys, tokens, caches and CDR.

The form of tokens and caches is that of the bridge's sources (`liveliness_mgt.rs`,
`route_publisher.rs` of eclipse-zenoh/zenoh-plugin-ros2dds).

What a robot in ROS sends as it drives through three rooms.
"""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh
from zenoh.ext import CacheConfig, MissDetectionConfig, declare_advanced_publisher

from tests.support.ros_messages import (
    OPTICAL,
    SECOND,
    START,
    TYPES,
    box,
    detection,
    detections,
    embeddings,
    flat,
    grid,
    tf,
    transform,
)

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


TF, BOXES = "tf2_msgs/msg/TFMessage", "vision_msgs/msg/Detection2DArray"
TEXT, GRID = "std_msgs/msg/String", "nav_msgs/msg/OccupancyGrid"
KINDS = {"/tf": TF, "/tf_static": TF, "/detections": BOXES, "/embeddings": TEXT, "/map": GRID}
LATCHED = ("/tf_static", "/map")
Sent = list[tuple[str, Any]]


def static() -> Any:
    links = [
        transform("base_link", "camera", 0, flat(0.2, 0.0, 0.0, 0.3)),
        transform("camera", "optical", 0, OPTICAL),
    ]
    return tf(*links)


def drive(keyframes: int) -> Sent:
    """A robot drives through three rooms: transforms, and a picture between two of them, with its
    embedding behind. Each picture is complete with the transform after it."""
    sent: Sent = [("/tf_static", static()), ("/map", grid(START, [0, 100, -1, 50, 0, 0], 3, 2))]
    for number in range(keyframes):
        ns = START + number * SECOND // 5
        angle, room = 0.3 * number, number % 3
        pose = flat(9.0 * room + math.cos(angle), math.sin(angle), 0.1 * number)
        sent.append(("/tf", tf(transform("map", "base_link", ns, pose))))
        each = detection([(f"thing-{room}", 0.9)], box(100.0, 50.0, 20.0 + number % 7, 10.0))
        vector = [1.0, float(room), 0.5, 0.25]
        sent.append(("/detections", detections(ns + 10_000_000, "optical", each)))
        sent.append(("/embeddings", embeddings(ns + 10_000_000, [vector])))
        after = transform("map", "base_link", ns + 20_000_000, pose)
        sent.append(("/tf", tf(after)))
    return sent
