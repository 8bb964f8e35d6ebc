"""Poses of envelopes from messages of ROS, which are made by hand."""

import json
import math
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.ros.assembler import Assembled, Assembler, RosMessage
from eventsrc.ros.stream import Stream
from eventsrc.ros.transforms import compose
from tests.support import ros_messages as ros
from tests.support.ros_messages import OPTICAL, SECOND, START, flat
from tests.support.ros_streams import (
    BASE_TO_CAMERA,
    CUP,
    MS,
    TYPES,
    message,
    moving,
    picture,
    run,
    static,
    stream,
)


def test_the_pose_is_interpolated_at_the_stamp_and_is_where_the_camera_is() -> None:
    (made,), assembler = run(
        [
            static(),
            moving(0, "map", "odom", flat(10.0, 0.0, math.pi / 2)),
            moving(400, "map", "odom", flat(10.0, 0.0, math.pi / 2)),
            moving(100, "odom", "base_link", flat(1.0, 0.0, 0.0)),
            picture(125, CUP),
            moving(200, "odom", "base_link", flat(2.0, 0.0, 0.4)),
        ]
    )
    # a quarter of the way; the map's y is the odometry's x
    base = compose(flat(10.0, 0.0, math.pi / 2), flat(1.25, 0.0, 0.1))
    expected = compose(base, BASE_TO_CAMERA)
    assert made["map_x"] == pytest.approx(expected.x, abs=1e-6)
    assert made["map_y"] == pytest.approx(expected.y, abs=1e-6)
    assert made["map_yaw"] == pytest.approx(math.pi / 2 + 0.1, abs=1e-9)
    assert (made["run_id"], made["keyframe_id"]) == ("r", 0)
    assert made["timestamp"] == START / SECOND + 0.125
    assert made["detections"] == [
        {"class": "cup", "confidence": 0.9, "bbox": [90.0, 45.0, 110.0, 55.0]}
    ]
    counts = assembler.counts["/detections"]
    assert (counts.keyframes, counts.detections, counts.without_pose) == (1, 1, 0)


@pytest.mark.parametrize(("turn", "name"), [(0.0, "optical"), (math.pi / 2, "left_sensor")])
def test_the_angle_of_the_camera_is_told_whatever_its_frame_is_called(
    turn: float, name: str
) -> None:
    mount = [
        ros.transform("base_link", "camera", 0, flat(0.1, 0.2, turn)),
        ros.transform("camera", name, 0, OPTICAL),
    ]
    for frame in (name, "camera"):
        (made,), _ = run(
            [
                message("/tf_static", 0, ros.tf(*mount)),
                moving(0, "map", "base_link", flat(0.0, 0.0, 3.0)),
                moving(10, "map", "base_link", flat(0.0, 0.0, 3.0)),
                message("/camera_info", 0, ros.camera_info(START, frame, 320.0)),
                picture(5, frame=frame),
            ],
            stream(camera="/camera_info"),
        )
        assert made["map_yaw"] == 3.0
        assert made["camera"]["yaw_rad"] == pytest.approx(turn, abs=1e-9)
        assert made["camera"]["hfov_deg"] == pytest.approx(90.0)
        assert (made["camera"]["width_px"], made["camera"]["height_px"]) == (640.0, 480.0)


def test_detections_wait_for_late_transforms_and_keep_their_order() -> None:
    assembler: Assembler[str] = Assembler([stream()])
    still = flat(0.0, 0.0, 0.0)
    out: list[Any] = [*assembler.add(static()), *assembler.add(picture(50))]
    out += assembler.put("between", START + 60 * MS)
    out += assembler.add(picture(70))
    for stamp in (0, 100):
        out += assembler.add(moving(stamp, "odom", "base_link", still, received_ms=80))
        assert out == []
    out += assembler.add(moving(90, "map", "odom", still, received_ms=90))
    out += assembler.add(moving(60, "map", "odom", still, received_ms=91))
    assert out == [], "the first has no sample before it"
    out += assembler.add(moving(10, "map", "odom", still, received_ms=92))
    assert [isinstance(each, Assembled) for each in out] == [True, False, True]
    assert out[1] == "between"
    assert [json.loads(e.payload)["keyframe_id"] for e in out if e != "between"] == [0, 1]


def test_what_never_gets_a_pose_is_kept_without_one_after_a_bounded_wait() -> None:
    assembler: Assembler[Any] = Assembler([stream(wait_ns=SECOND)])
    assert assembler.add(picture(0, CUP)) == []
    assert assembler.add(moving(900, "map", "elsewhere", flat(0.0, 0.0, 0.0))) == []
    (late,) = assembler.add(moving(1_001, "map", "elsewhere", flat(0.0, 0.0, 0.0)))
    made = json.loads(late.payload)
    assert not {"map_x", "map_y", "map_yaw"} & made.keys()
    assert len(made["detections"]) == 1
    assert assembler.counts["/detections"].without_pose == 1


def test_the_number_of_those_that_wait_is_bounded() -> None:
    assembler: Assembler[Any] = Assembler([stream(max_waiting=3)])
    out = [each for at in range(10) for each in assembler.add(picture(at))]
    assert len(out) == 7
    assert len(assembler.finish()) == 3


def test_samples_too_far_apart_are_not_interpolated() -> None:
    link = [moving(at, "map", "base_link", flat(0.0, 0.0, 0.0)) for at in (0, 600)]
    for gap_ms, has_pose in ((599, False), (600, True)):
        (made,), _ = run([static(), *link, picture(300)], stream(max_gap_ns=gap_ms * MS))
        assert ("map_x" in made) is has_pose


def test_without_the_cameras_transform_the_pose_is_the_bases() -> None:
    link = [moving(at, "map", "base_link", flat(1.0, 2.0, 0.5)) for at in (0, 100)]
    (made,), assembler = run([*link, picture(50, frame="nowhere")])
    assert (made["map_x"], made["map_y"], made["map_yaw"]) == (1.0, 2.0, 0.5)
    assert assembler.counts["/detections"].without_camera_frame == 1
    (made,), assembler = run([*link, picture(50, frame="")])
    assert assembler.counts["/detections"].without_camera_frame == 0, "it names none"
    (made,), assembler = run([*link, picture(50, frame="base_link")], stream(base_frame="x"))
    assert made["map_yaw"] == 0.5
    assert assembler.counts["/detections"].without_base_frame == 1


FULL = ros.six_by_six(0.04, 0.01, 0.09, 0.02)


NINE = [0.04, 0.01, 0.0, 0.01, 0.09, 0.0, 0.0, 0.0, 0.02]


def test_odometry_gives_pose_covariance_and_frame() -> None:
    messages = [
        message("/odom", at, ros.odometry(START + at * MS, "odom", "base", flat(x, 0.0, 0.0), c))
        for at, x, c in ((0, 0.0, FULL), (100, 1.0, 3.0 * FULL))
    ]
    mount = ros.tf(ros.transform("base", "optical", 0, OPTICAL))
    chosen = stream(pose="/odom")
    (made,), assembler = run(
        [message("/tf_static", 0, mount), messages[0], picture(50), messages[1]], chosen
    )
    assert (made["map_x"], made["map_yaw"]) == (0.5, 0.0)
    assert made["pose_covariance"] == pytest.approx([2.0 * x for x in NINE])
    assert assembler.frames() == {"/detections": "odom"}
    assert isinstance(ingest(json.dumps(made).encode()), Accepted)
    _, assembler = run(
        [*messages, message("/odom", 101, ros.odometry(START, "map", "base", flat(0, 0, 0)))],
        chosen,
    )
    assert assembler.counts["/detections"].unused == {"/odom": 1}


def test_the_latest_covariance_goes_with_poses_of_transforms() -> None:
    link = [moving(at, "map", "base_link", flat(0.0, 0.0, 0.0)) for at in (0, 200)]

    def given(at: int, c: Any, frame: str = "map") -> RosMessage:
        pose = ros.pose_with_covariance(START + at * MS, frame, flat(5.0, 5.0, 0.0), c)
        return message("/amcl_pose", at, pose)

    bad = FULL.copy()
    bad[1] = 0.5
    other = [given(30, 2.0 * FULL), given(150, 9.0 * FULL), given(40, 5.0 * FULL, "odom")]
    made, assembler = run(
        [*link, picture(10, frame=""), given(20, FULL), *other, picture(100, frame="")],
        stream(covariance="/amcl_pose"),
    )
    assert "pose_covariance" not in made[0]
    assert made[1]["pose_covariance"] == pytest.approx([2.0 * x for x in NINE])
    assert made[1]["map_x"] == 0.0
    counts = assembler.counts["/detections"]
    assert (counts.without_covariance, counts.unused) == (1, {"/amcl_pose": 1})
    for values, refused in ((np.zeros(36), 0), (bad, 1), (FULL * math.nan, 1), (-FULL, 1)):
        (made_,), assembler = run(
            [*link, given(20, values), picture(100, frame="")], stream(covariance="/amcl_pose")
        )
        assert "pose_covariance" not in made_, "zeros mean that the sender does not know"
        assert sum(assembler.counts["/detections"].unused.values()) == refused


def test_without_topics_of_poses_nothing_waits_for_one() -> None:
    assembler: Assembler[Any] = Assembler([stream(tf=None, tf_static=None)])
    (made,) = assembler.add(picture(0, CUP))
    assert "map_x" not in json.loads(made.payload)
    assert assembler.counts["/detections"].without_pose == 1


def test_two_robots_have_their_own_transforms_and_runs() -> None:
    streams = [
        Stream(f"/{name}/detections", name, tf=f"/{name}/tf", tf_static=None)
        for name in ("one", "two")
    ]
    messages = []
    for name, x in (("one", 1.0), ("two", 2.0)):
        for at in (0, 100):
            link = ros.tf(ros.transform("map", "base_link", START + at * MS, flat(x, 0, 0)))
            messages.append(RosMessage(f"/{name}/tf", TYPES["/tf"], START, link))
    for name in ("two", "one", "two"):
        shown = ros.detections(START + 50 * MS, "", CUP)
        messages.append(RosMessage(f"/{name}/detections", TYPES["/detections"], START, shown))
    made, assembler = run(messages, *streams)
    assert [(m["run_id"], m["keyframe_id"], m["map_x"]) for m in made] == [
        ("two", 0, 2.0),
        ("one", 0, 1.0),
        ("two", 1, 2.0),
    ]
    assert assembler.topics == {f"/{n}/{t}" for n in ("one", "two") for t in ("detections", "tf")}


def test_two_cameras_of_a_robot_share_its_transforms() -> None:
    streams = [stream(detections=f"/{name}", run_id=name) for name in ("front", "rear")]
    link = [moving(at, "map", "base_link", flat(0, 0, 0)) for at in (0, 100)]
    mount = ros.tf(
        ros.transform("base_link", "front", 0, flat(0.5, 0, 0)),
        ros.transform("base_link", "rear", 0, flat(-0.5, 0, math.pi)),
    )
    shown = [
        RosMessage(f"/{name}", TYPES["/detections"], START, ros.detections(START, name))
        for name in ("front", "rear")
    ]
    made, _ = run([message("/tf_static", 0, mount), *link, *shown], *streams)
    assert [(m["map_x"], m["map_yaw"]) for m in made] == [(0.5, 0.0), (-0.5, 0.0)]


def test_heights_are_stated_on_request() -> None:
    link = [moving(at, "map", "base_link", flat(0, 0, 0, 3.1)) for at in (0, 100)]
    for heights in (False, True):
        (made,), _ = run([*link, picture(50, frame="")], stream(heights=heights))
        assert made.get("map_z") == (3.1 if heights else None)


def test_the_same_messages_make_the_same_envelopes() -> None:
    rng = np.random.default_rng(5)
    messages: list[RosMessage] = [static()]
    for at in range(0, 3_000, 20):
        place = flat(*rng.normal(size=3).tolist())
        late = at + int(rng.integers(0, 1_500))
        messages.append(moving(at, "map", "base_link", place, received_ms=late))
        if at % 100 == 0:
            messages.append(picture(at + 7, CUP))
    messages.sort(key=lambda m: m.received_ns)
    chosen = stream(wait_ns=SECOND // 5, max_gap_ns=100 * MS)
    first, _ = run(messages, chosen)
    assert first == run(messages, chosen)[0]
    assert {"map_x" in each for each in first} == {True, False}
