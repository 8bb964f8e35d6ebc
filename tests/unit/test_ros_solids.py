"""Things that a detector measures in three dimensions: their position, height, size and box."""

import json
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.ros.assembler import RosMessage
from eventsrc.ros.transforms import IDENTITY, Transform
from tests.support import ros_messages as ros
from tests.support.ros_messages import START, flat
from tests.support.ros_streams import CUP, message, moving, picture, run, static, stream

SIDEWAYS = flat(2.0, 1.0, math.pi / 2)
"""The robot looks along y; its camera is 0.25 m ahead of it and 0.3 m above the ground."""


def measured(t: Transform, **covariance: float) -> Any:
    """A cup that its hypothesis puts somewhere in the frame of the camera."""
    one = ros.detection([("spoon", 0.2), ("cup", 0.9)], ros.box(100.0, 50.0, 20.0, 10.0))
    matrix = np.zeros((6, 6))
    for at, axis in enumerate("xyz"):
        matrix[at, at] = covariance.get(axis, 0.0)
    for result in one.results:
        at = t if result.hypothesis.class_id == "cup" else flat(9.0, 9.0, 0.0)
        result.pose = ros.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=ros.pose(at), covariance=matrix.reshape(36)
        )
    return one


def solids(*each: Any, frame: str = "optical") -> RosMessage:
    content = ros.solids(START, frame, *each)
    return RosMessage("/detections", "vision_msgs/msg/Detection3DArray", START, content)


def seen(*messages: RosMessage, **more: Any) -> list[dict[str, Any]]:
    """The detections of the only keyframe, which is valid."""
    at = moving(0, "map", "base_link", SIDEWAYS)
    (made,), _ = run([static(), at, *messages], stream(**more))
    assert isinstance(ingest(json.dumps(made).encode()), Accepted)
    found: list[dict[str, Any]] = made["detections"]
    return found


def test_the_pose_of_the_best_hypothesis_becomes_a_position_in_the_map() -> None:
    ahead = Transform(0.5, -0.2, 3.0, *IDENTITY[3:])  # right, up and ahead of the camera
    (cup,) = seen(picture(0, measured(ahead, x=0.0001, z=0.0025)))
    assert cup["position"] == pytest.approx([2.5, 4.25], abs=1e-6)
    assert cup["position_z"] == pytest.approx(0.5, abs=1e-6)
    assert cup["position_sigma_m"] == pytest.approx(math.sqrt(0.0013), abs=1e-6)
    assert cup["bbox"] == [90.0, 45.0, 110.0, 55.0]
    assert "size" not in cup
    assert "depth_m" not in cup


def test_without_a_stated_error_it_is_that_of_a_depth() -> None:
    (far,) = seen(picture(0, measured(Transform(0.0, 0.0, 4.0, *IDENTITY[3:]))))
    (near,) = seen(picture(0, measured(Transform(0.0, 0.0, 0.4, *IDENTITY[3:]))))
    assert (far["position_sigma_m"], near["position_sigma_m"]) == (0.2, 0.05)


def test_the_error_of_the_pose_is_added() -> None:
    covariance = ros.six_by_six(0.01, 0.0, 0.03, 0.0025)
    given = message("/amcl_pose", 0, ros.pose_with_covariance(START, "map", SIDEWAYS, covariance))
    at = Transform(0.0, 0.0, 2.0, *IDENTITY[3:])
    (cup,) = seen(given, picture(0, measured(at, x=0.0004, z=0.0004)), covariance="/amcl_pose")
    assert cup["position_sigma_m"] == pytest.approx(
        math.sqrt(0.0004 + 0.02 + 0.00125 * 4), abs=1e-6
    )


@pytest.mark.parametrize("nowhere", [(0.0, 0.0, 0.0), (math.nan, 0.0, 1.0), (0.0, 0.0, 2e3)])
def test_a_position_of_zeros_or_nan_or_very_far_is_none(nowhere: tuple[float, ...]) -> None:
    (cup,) = seen(picture(0, measured(Transform(*nowhere, 0.0, 0.0, 0.0, 0.0))))
    assert set(cup) == {"class", "confidence", "bbox"}


def test_an_orientation_of_zeros_is_none_and_the_position_counts() -> None:
    (cup,) = seen(picture(0, measured(Transform(0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0))))
    assert cup["position"] == pytest.approx([2.0, 2.25])


def test_without_a_pose_a_measured_thing_has_its_distance() -> None:
    at = Transform(3.0, 0.0, 4.0, *IDENTITY[3:])
    (made,), _ = run([picture(0, measured(at, x=0.0, z=0.01), CUP)], stream(tf=None))
    cup, other = made["detections"]
    assert (cup["depth_m"], cup["depth_sigma_m"]) == (5.0, pytest.approx(0.08))
    assert "position" not in cup
    assert set(other) == {"class", "confidence", "bbox"}


def test_a_solid_has_a_size_by_how_it_stands_and_a_box_in_the_picture() -> None:
    turned = Transform(0.0, 0.0, 2.0, 0.0, math.sin(0.2), 0.0, math.cos(0.2))  # about the vertical
    lens = message("/camera_info", 0, ros.camera_info(START, "optical", 320.0))
    (chair,) = seen(lens, solids(ros.solid("chair", turned, 0.4, 0.9, 0.6)), camera="/camera_info")
    assert chair["position"] == pytest.approx([2.0, 3.25])
    assert chair["position_z"] == pytest.approx(0.3)
    assert chair["size"] == [0.6, 0.4, 0.9]
    left, top, right, bottom = chair["bbox"]
    assert 0.0 < left < 320.0 < right < 640.0
    assert left + right == pytest.approx(640.0, abs=25.0)
    assert 240.0 - top == pytest.approx(bottom - 240.0)
    assert bottom - top > 320.0 * 0.9 / 2.0


def test_a_solid_has_no_box_where_nothing_says_how_the_camera_sees_it() -> None:
    ahead = Transform(0.0, 0.0, 2.0, *IDENTITY[3:])
    aside = Transform(9.0, 0.0, 1.0, *IDENTITY[3:])
    behind = Transform(0.0, 0.0, -1.0, *IDENTITY[3:])
    (chair,) = seen(solids(ros.solid("chair", ahead, 0.0, 0.0, 0.0)))
    assert (chair["bbox"], "size" in chair) == ([0.0] * 4, False)
    lens = message("/camera_info", 0, ros.camera_info(START, "optical", 320.0))
    around = [ros.solid("chair", each, 0.1, 0.1, 0.1) for each in (aside, behind)]
    assert [d["bbox"] for d in seen(lens, solids(*around), camera="/camera_info")] == [
        [0.0] * 4
    ] * 2
    other = message("/camera_info", 0, ros.camera_info(START, "other_optical", 320.0))
    of_lidar = solids(ros.solid("chair", flat(2.0, 0.0, 0.0), 0.1, 0.2, 0.3), frame="base_link")
    (made,), assembler = run(
        [static(), moving(0, "map", "base_link", SIDEWAYS), other, of_lidar],
        stream(camera="/camera_info"),
    )
    assert "camera" not in made
    assert made["detections"][0]["position"] == pytest.approx([2.0, 3.0])
    assert made["detections"][0]["size"] == [0.2, 0.1, 0.3]
    assert assembler.counts["/detections"].with_position == 1


def test_hypotheses_of_vision_msgs_2_have_a_pose_too() -> None:
    given = SimpleNamespace(
        pose=ros.pose(Transform(0.0, 0.0, 1.0, *IDENTITY[3:])), covariance=np.zeros(36)
    )
    result = SimpleNamespace(id="cup", score=0.9, pose=given)
    old = SimpleNamespace(results=[result], bbox=ros.box(9.0, 9.0, 2.0, 2.0))
    array = SimpleNamespace(header=ros.header(START, "optical"), detections=[old])
    (cup,) = seen(message("/detections", 0, array))
    assert cup["position"] == pytest.approx([2.0, 2.25])


def test_a_camera_that_sees_no_angle_is_refused() -> None:
    lens = message("/camera_info", 0, ros.camera_info(START, "optical", 1e300))
    cup = ros.solid("cup", Transform(0.5, -0.2, 3.0, *IDENTITY[3:]), 0.2, 0.2, 0.2)
    (made,), assembler = run([lens, solids(cup)], stream(camera="/camera_info"))
    assert "camera" not in made
    assert assembler.counts["/detections"].unused == {"/camera_info": 1}
