"""Detections of ROS in envelopes: hypotheses, boxes, embeddings, and what is not of its type."""

import json
import math
from types import SimpleNamespace
from typing import Any

import pytest

from eventsrc.envelope.ingest import Accepted, Rejected, ingest
from eventsrc.ros.assembler import Assembler, RosMessage
from eventsrc.ros.messages import BadMessage
from eventsrc.ros.transforms import Transform
from tests.support import ros_messages as ros
from tests.support.ros_messages import SECOND, START, flat
from tests.support.ros_streams import (
    CUP,
    message,
    picture,
    run,
    stream,
)


def test_of_several_hypotheses_the_best_counts_and_labels_name_ids() -> None:
    each = [
        ros.detection([("3", 0.2), ("7", 0.8), ("9", 0.8)], ros.box(10, 10, 4, 2)),
        ros.detection([], ros.box(10, 10, 4, 2)),
        ros.detection([("", 0.4)], ros.box(10, 10, 4, 2)),
        ros.detection([("12", math.nan), ("13", 0.1)], ros.box(10, 10, 4, 2)),
    ]
    (made,), assembler = run([picture(0, *each)], stream(labels={"7": "chair"}))
    assert [(d["class"], d["confidence"]) for d in made["detections"][:3]] == [
        ("chair", 0.8),
        ("unclassified", 0.0),
        ("unclassified", 0.4),
    ]
    assert assembler.counts["/detections"].unclassified == 2
    # a score that is none is no better than any other
    assert made["detections"][3]["class"] == "13"


def test_classes_have_the_names_that_messages_tell_and_detections_wait_for_them() -> None:
    seen = [ros.detection([(name, 0.9)], ros.box(9, 9, 2, 2)) for name in ("0", "17", "5", "cup")]
    told = message("/label_info", 40, ros.label_info(START, {0: "person", 17: "chair"}))
    of_user = stream(classes=("/label_info",), labels={"17": "stool"}, tf=None, tf_static=None)
    assembler: Assembler[Any] = Assembler([of_user])
    assert assembler.add(picture(0, *seen)) == []
    (made,) = assembler.add(told)
    classes = [each["class"] for each in json.loads(made.payload)["detections"]]
    assert classes == ["person", "stool", "5", "cup"]
    assert assembler.counts["/detections"].numbered == 1
    # what never comes is not waited for longer than a second
    (early, later), assembler = run([picture(0, *seen), picture(1_500, *seen)], of_user)
    assert [each["class"] for each in early["detections"]] == ["0", "stool", "5", "cup"]
    assert early["detections"] == later["detections"]
    assert assembler.counts["/detections"].numbered == 4


def test_older_forms_of_detections_are_read() -> None:
    """vision_msgs 3 has the centre without a position, version 2 the id without a hypothesis."""
    center = SimpleNamespace(x=100.0, y=50.0, theta=0.0)
    bbox = SimpleNamespace(center=center, size_x=20.0, size_y=10.0)
    hypothesis = SimpleNamespace(class_id="cup", score=0.9)
    for result in (
        SimpleNamespace(hypothesis=hypothesis),
        SimpleNamespace(id="cup", score=0.9),
    ):
        old = SimpleNamespace(results=[result], bbox=bbox)
        array = SimpleNamespace(header=ros.header(START, "optical"), detections=[old])
        (made,), _ = run([message("/detections", 0, array)])
        assert made["detections"] == [
            {"class": "cup", "confidence": 0.9, "bbox": [90.0, 45.0, 110.0, 55.0]}
        ]


def test_a_turned_box_becomes_the_one_around_it() -> None:
    turned = ros.detection([("cup", 0.9)], ros.box(0.0, 0.0, 20.0, 10.0, math.pi / 2))
    (made,), _ = run([picture(0, turned)])
    assert made["detections"][0]["bbox"] == pytest.approx([-5.0, -10.0, 5.0, 10.0])


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("kind", ["list", "ids", "floats"])
def test_embeddings_join_the_detections_of_their_stamp(kind: str, late: bool) -> None:
    each = [
        ros.detection([("cup", 0.9)], ros.box(1, 1, 2, 2), "b"),
        ros.detection([("cup", 0.8)], ros.box(9, 1, 2, 2), "a"),
    ]
    at = START + 7
    given: Any = {
        "list": message("/embeddings", 1, ros.embeddings(at, [[1.0, 2.0], [3.0, 4.0]])),
        "ids": message("/embeddings", 1, ros.embeddings(at, {"a": [3.0, 4.0], "b": [1.0, 2.0]})),
        "floats": message("/floats", 1, ros.float_rows(at, [[1.0, 2.0], [3.0, 4.0]])),
    }[kind]
    shown = message("/detections", 1, ros.detections(at, "", *each))
    topic = "/floats" if kind == "floats" else "/embeddings"
    (made,), assembler = run([shown, given] if late else [given, shown], stream(embeddings=topic))
    read = ingest(json.dumps(made).encode())
    assert isinstance(read, Accepted)
    assert [None if v is None else v.tolist() for v in read.vectors] == [[1.0, 2.0], [3.0, 4.0]]
    assert {d.embedding_model for d in read.envelope.detections} == {"m"}
    assert assembler.counts["/detections"].with_embedding == 2


def test_embeddings_that_fit_nothing_are_counted_not_guessed() -> None:
    short = message("/embeddings", 0, ros.embeddings(START, [[1.0]]))
    two = picture(0, CUP, CUP)
    for bad in (
        short,
        message("/embeddings", 0, ros.embeddings(START + 1, [[1.0], [2.0]])),
        message("/embeddings", 0, ros.text("no JSON")),
        message("/embeddings", 0, ros.text("[" * 100_000)),
        message("/embeddings", 0, ros.text('{"stamp": {"sec": 1}, "embeddings": []}')),
        message("/embeddings", 0, ros.text('{"stamp": 7, "embeddings": []}')),
        message("/embeddings", 0, ros.text('{"stamp": {"sec":1,"nanosec":1},"embeddings":[1]}')),
        RosMessage("/embeddings", "std_msgs/msg/Bool", START, SimpleNamespace(data=True)),
    ):
        (made,), assembler = run([bad, two], stream(embeddings="/embeddings"))
        assert not any("embedding" in d for d in made["detections"])
        assert assembler.counts["/detections"].unused == {"/embeddings": 1}, bad
        assert assembler.counts["/detections"].reasons["/embeddings"]
    wrong = ros.float_rows(START, [[1.0, 2.0]])
    wrong.layout.dim[0].size = 2**31
    (made,), assembler = run([message("/floats", 0, wrong), two], stream(embeddings="/floats"))
    assert assembler.counts["/detections"].unused == {"/floats": 1}


def test_embeddings_by_ids_that_no_detection_has_are_counted() -> None:
    cup = ros.detection([("cup", 0.9)], ros.box(1, 1, 2, 2), "a")
    given: dict[str, list[float] | None] = {"b": [1.0], "a": [3.0], "none": None, "c": [2.0]}
    cases: tuple[tuple[dict[str, list[float] | None], int], ...]
    cases = (given, 2), ({"a": None}, 0), ({}, 0)
    for by_id, refused in cases:
        embeddings = message("/embeddings", 0, ros.embeddings(START, by_id))
        (made,), assembler = run([embeddings, picture(0, cup)], stream(embeddings="/embeddings"))
        counts = assembler.counts["/detections"]
        assert counts.unused == ({"/embeddings": refused} if refused else {})
        assert counts.with_embedding == (by_id is given)
        assert ("embedding" in made["detections"][0]) is (by_id is given)
        if refused:
            assert "'b'" in counts.reasons["/embeddings"]


def test_numbers_that_no_envelope_may_have_are_left_for_ingest_to_refuse() -> None:
    nan = math.nan
    for bad in (
        ros.detections(START, "", ros.detection([("cup", nan)], ros.box(1, 1, 2, 2))),
        ros.detections(START, "", ros.detection([("cup", 0.5)], ros.box(nan, 1, 2, 2))),
        ros.detections(START, "", ros.detection([("cup", 0.5)], ros.box(1, 1, 2, 2, nan))),
        ros.detections(START, "", ros.detection([("a\x00b", 0.5)], ros.box(1, 1, 2, 2))),
        ros.detections(-5 * SECOND, "", CUP),
    ):
        assembler: Assembler[Any] = Assembler([stream()])
        (made,) = [*assembler.add(message("/detections", 0, bad)), *assembler.finish()]
        assert isinstance(ingest(made.payload), Rejected)


def test_messages_that_are_not_what_their_type_says() -> None:
    assembler: Assembler[Any] = Assembler([stream(camera="/camera_info", pose="/odom")])
    with pytest.raises(BadMessage):
        assembler.add(message("/detections", 0, SimpleNamespace(detections=[])))
    with pytest.raises(BadMessage, match="not vision_msgs"):
        assembler.add(RosMessage("/detections", "std_msgs/msg/String", 0, ros.text("")))
    bad_turn = ros.transform("a", "b", 0, Transform(0, 0, 0, 0, 0, 0, 0))
    bad_place = ros.transform("a", "b", 0, Transform(math.nan, 0, 0, 0, 0, 0, 1))
    good = ros.transform("a", "c", 0, flat(0, 0, 0))
    assert assembler.add(message("/tf", 0, ros.tf(bad_turn, good, bad_place))) == []
    assert assembler.add(message("/tf_static", 0, SimpleNamespace(transforms=3))) == []
    assert assembler.add(message("/camera_info", 0, ros.camera_info(0, "c", 0.0))) == []
    assert assembler.add(message("/odom", 0, ros.text("x"))) == []
    counts = assembler.counts["/detections"]
    assert counts.unused == {"/tf": 2, "/tf_static": 1, "/camera_info": 1, "/odom": 1}
    assert "unit quaternion" in counts.reasons["/tf"]
    assert counts.keyframes == 0


def test_rows_without_numbers_are_refused_before_they_are_counted_out() -> None:
    rows = ros.float_rows(START, [[1.0]])
    rows.data = rows.data[:0]
    rows.layout.dim[0].size, rows.layout.dim[1].size = 2**32 - 1, 0
    given = RosMessage("/embeddings", rows.__msgtype__, START, rows)
    _, assembler = run([given], stream(embeddings="/embeddings"))
    reason = assembler.counts["/detections"].reasons["/embeddings"]
    assert reason == "0 values where 4,294,967,295 × 0 are declared"
