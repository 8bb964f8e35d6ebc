"""A robot over rmw_zenoh that moves by odometry, and sees what a run of the simulation saw."""

import base64
import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from eventsrc.ros.transforms import compose
from tests.support import rmw
from tests.support.logs import simulated
from tests.support.ros2dds import KINDS, static
from tests.support.ros_messages import (
    SECOND,
    START,
    box,
    camera_info,
    detection,
    detections,
    embeddings,
    flat,
    tf,
    transform,
)

CAMERA_AHEAD_M = 0.2
"""As `static` says."""
ODOM = flat(3.0, -2.0, 0.7)
"""The map's origin in the frame of odometry."""
_MOST = 2_000
_EVERY_NS = 500_000_000


def look_around(robot: rmw.Node, is_told: Callable[[], bool]) -> list[dict[str, Any]]:
    """Send keyframes until ``is_told``, which waits between them; returns their envelopes, with
    poses in the map."""
    lens = camera_info(START, "optical", 320 / math.tan(math.radians(69.4) / 2), 640, 400)
    keyframes = [*simulated(7, "b").payloads][40:60]
    for topic in ("/tf", "/tf_static", "/detections", "/embeddings"):
        robot.advertise(topic, KINDS[topic])
    robot.advertise("/camera_info", lens.__msgtype__)
    robot.send("/tf_static", static())
    sent: list[dict[str, Any]] = []
    while len(sent) < _MOST and not is_told():
        sent.append(json.loads(keyframes[len(sent) % len(keyframes)]))
        robot.send("/camera_info", lens)
        for topic, message in _sent(sent[-1], START + len(sent) * _EVERY_NS):
            robot.send(topic, message)
    return sent


def _sent(envelope: dict[str, Any], stamp_ns: int) -> Iterator[tuple[str, Any]]:
    """Transforms of odometry around a keyframe, its detections, their embeddings."""
    yaw = envelope["map_yaw"]
    x, y = (envelope[f"map_{axis}"] for axis in "xy")
    base = flat(x - CAMERA_AHEAD_M * math.cos(yaw), y - CAMERA_AHEAD_M * math.sin(yaw), yaw)
    for at in (stamp_ns - 1_000_000, stamp_ns + 1_000_000):
        yield "/tf", tf(transform("odom", "base_link", at, compose(ODOM, base)))
    found, looks, model = [], [], None
    for each in envelope["detections"]:
        x0, y0, x1, y1 = each["bbox"]
        middle = box((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0)
        found.append(detection([(each["class"], each["confidence"])], middle))
        looks.append(np.frombuffer(base64.b64decode(each["embedding"]), "<f4"))
        model = each["embedding_model"]
    yield "/detections", detections(stamp_ns, "optical", *found)
    if found:
        yield "/embeddings", embeddings(stamp_ns, looks, model)


def check_initial_pose(message: Any, sent: list[dict[str, Any]]) -> None:
    """The pose of the base is that at the keyframe of its stamp, and says how sure it is."""
    assert message.header.frame_id == "map"
    at, look = message.pose.pose.position, message.pose.pose.orientation
    yaw = 2 * math.atan2(look.z, look.w)
    camera = at.x + CAMERA_AHEAD_M * math.cos(yaw), at.y + CAMERA_AHEAD_M * math.sin(yaw)
    stamp = message.header.stamp
    number = round((stamp.sec * SECOND + stamp.nanosec - START) / _EVERY_NS)
    envelope = sent[number - 1]
    assert math.dist(camera, (envelope["map_x"], envelope["map_y"])) < 1.0
    assert abs(math.remainder(yaw - envelope["map_yaw"], math.tau)) < math.radians(20.0)
    assert min(message.pose.covariance[i] for i in (0, 7, 35)) > 0.0
