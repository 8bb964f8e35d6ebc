"""Range scans of ROS in envelopes: which one, where its sensor is, and what its beams say."""

import json
import math
from typing import Any

import numpy as np
import pybase64
import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.ros.assembler import Assembler, RosMessage
from eventsrc.ros.measured import LASER_SCAN
from eventsrc.ros.transforms import Transform
from tests.support import ros_messages as ros
from tests.support.ros_messages import START, flat
from tests.support.ros_streams import CUP, MS, moving, picture, run, static, stream

MOUNT = flat(-0.1, 0.3, math.pi / 2, 0.2)
"""The sensor stands behind and to the left of the base and faces left."""
HANGING = Transform(0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0)
"""Upside down."""


def laser(at_ms: int, ranges: Any, received_ms: int | None = None, **fields: Any) -> RosMessage:
    about = {"angle_min": -1.0, "angle_increment": 0.5, **fields}
    content = ros.laser_scan(START + at_ms * MS, "laser", ranges, **about)
    return RosMessage(
        "/scan", LASER_SCAN, START + (at_ms if received_ms is None else received_ms) * MS, content
    )


def mounted(t: Transform = MOUNT) -> RosMessage:
    content = ros.tf(ros.transform("base_link", "laser", 0, t))
    return RosMessage("/tf_static", "tf2_msgs/msg/TFMessage", START, content)


def ranges_of(scan: dict[str, Any]) -> list[int]:
    return np.frombuffer(pybase64.b64decode(scan["ranges_mm"]), "<u2").tolist()


def driving() -> list[RosMessage]:
    places = [(at, flat(0.001 * at, 1.0, math.pi / 2)) for at in (0, 400, 800)]
    return [static(), mounted(), *(moving(at, "map", "base_link", t) for at, t in places)]


def test_the_nearest_scan_goes_with_its_keyframe_told_from_the_pose_of_the_picture() -> None:
    messages = [
        *driving(),
        laser(100, [1.0], 100),
        laser(180, [2.0, 3.0, 4.0], 180),
        laser(350, [5.0], 350),
        picture(200, CUP, received_ms=400),
    ]
    (made,), assembler = run(messages, stream(scan="/scan"))
    assert isinstance(read := ingest(json.dumps(made).encode()), Accepted)
    scan = made["scan"]
    assert ranges_of(scan) == [2000, 3000, 4000]
    assert (scan["angle_min"], scan["angle_step"], scan["range_max"]) == (-1.0, 0.5, 8.0)
    # the camera is 0.25 m ahead of the base, which drove 0.02 m to its right since the scan
    assert (scan["x"], scan["y"]) == pytest.approx((-0.35, 0.32), abs=1e-6)
    assert scan["yaw"] == pytest.approx(math.pi / 2)
    assert read.envelope.scan is not None
    assert assembler.counts["/detections"].with_scan == 1


def test_a_keyframe_waits_for_the_scan_behind_it_but_not_for_ever() -> None:
    assembler: Assembler[Any] = Assembler([stream(scan="/scan")])
    for message in [*driving(), picture(200, CUP, received_ms=1000)]:
        assert assembler.add(message) == []
    (made,) = assembler.add(laser(210, [1.5], 1010))
    assert ranges_of(json.loads(made.payload)["scan"]) == [1500]
    (alone,), _ = run([*driving(), picture(600, CUP), laser(900, [1.0])], stream(scan="/scan"))
    assert "scan" not in alone


def test_beams_are_millimetres_unknown_or_without_an_end() -> None:
    ranges = [0.05, math.nan, math.inf, 8.5, -math.inf, 0.1234, 7.9]
    (made,), _ = run([*driving(), laser(200, ranges), picture(200, CUP)], stream(scan="/scan"))
    assert ranges_of(made["scan"]) == [0, 0, 65535, 65535, 0, 123, 7900]


def test_of_many_beams_every_second_is_taken_and_a_hanging_sensor_turns_the_other_way() -> None:
    many = laser(200, np.arange(500) / 100 + 1.0, angle_increment=0.01)
    hanging = driving()
    hanging[1] = mounted(HANGING)
    (made,), _ = run([*hanging, many, picture(200, CUP)], stream(scan="/scan"))
    scan = made["scan"]
    assert (len(ranges_of(scan)), ranges_of(scan)[1]) == (250, 1020)
    assert (scan["angle_min"], scan["angle_step"]) == (1.0, -0.02)


def test_scans_that_cannot_be_used_are_counted_or_left_out() -> None:
    for bad in (laser(200, []), laser(200, [1.0], range_max=0.0)):
        (made,), assembler = run([*driving(), bad, picture(200, CUP)], stream(scan="/scan"))
        assert "scan" not in made
        assert assembler.counts["/detections"].unused == {"/scan": 1}
    first, _, *poses = driving()
    nowhere = [first, *poses]
    (made,), _ = run([*nowhere, laser(200, [1.0]), picture(200, CUP)], stream(scan="/scan"))
    assert "scan" not in made  # no transform leads to its frame
