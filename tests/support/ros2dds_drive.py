"""What a robot in ROS sends as it drives through three rooms."""

import math
from typing import Any

from tests.support.ros_messages import (
    OPTICAL,
    SECOND,
    START,
    box,
    detection,
    detections,
    embeddings,
    flat,
    grid,
    tf,
    transform,
)

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
