"""Logs that hold verbatim messages (ROS in CDR, JPEG) and envelopes side by side."""

import json
import math
import random

from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.log import Event, MessageFormat, NewEvent, VerbatimEvent

KEY = "tb/detections"
TF = MessageFormat(
    "cdr", "tf2_msgs/msg/TFMessage", "ros2msg", b"geometry_msgs/TransformStamped[] transforms"
)
BOXES = MessageFormat(
    "cdr", "vision_msgs/msg/Detection2DArray", "ros2msg", b"std_msgs/Header header\n" * 40
)
JPEG = MessageFormat("jpeg")
_CDR = b"\x00\x01\x00\x00"


def mixed_event(offset: int) -> NewEvent:
    """What stands at ``offset``: of four events one is an envelope. Some verbatim messages are
    valid envelopes, or look like parts of a log."""
    rng = random.Random(offset)
    logged_ns, stamp_ns = 10**18 + offset, 10**18 + offset - 5
    kind = offset % 4
    if kind == 3:
        number = offset // 4
        return NewEvent(KEY, keyframe(number), logged_ns, (1000 + number) * 10**9)
    if kind == 2:
        content = b"\xff\xd8\xff\xe0" + rng.randbytes(rng.choice((0, 100, 3000))) + b"\xff\xd9"
        return NewEvent("tb/crops", content, logged_ns, stamp_ns, form_version(), JPEG)
    topic, form = ("/tf", TF) if kind == 0 else ("/detections", BOXES)
    content = rng.choice((_CDR + rng.randbytes(rng.choice((0, 8, 900))), keyframe(10**6 + offset)))
    return NewEvent(topic, content, logged_ns, 10**19 // 2 - offset, form_version(), form)


def form_version() -> int:
    """The version of a `NewEvent` that has a format: it has no meaning there."""
    return ENVELOPE_VERSION


def keyframe(number: int) -> bytes:
    """Keyframe ``number`` of a run through three rooms, with things in it."""
    room, angle = number % 3, 0.4 * number
    return json.dumps(
        {
            "run_id": "drive",
            "keyframe_id": number,
            "timestamp": 1000.0 + number,
            "map_x": 8.0 * room + math.cos(angle),
            "map_y": math.sin(angle),
            "map_yaw": 0.0,
            "detections": [{"class": f"thing-{room}", "confidence": 0.9, "bbox": [1, 2, 30, 40]}],
        }
    ).encode()


def recorded(new: NewEvent, offset: int) -> Event:
    """The event that a log has of ``new``."""
    values = offset, new.key, new.logged_ns, new.stamp_ns, new.payload
    if new.format is None:
        return Event(*values)
    return VerbatimEvent(*values, format=new.format)


def mixed_events(count: int) -> list[Event]:
    """The first ``count`` events of `mixed_event`, as a log has them."""
    return [recorded(mixed_event(offset), offset) for offset in range(count)]
