"""Names of classes that nodes of ROS tell: LabelInfo, parameters, VisionInfo."""

from types import SimpleNamespace
from typing import Any

import pytest

from eventsrc.ros.messages import DETECTIONS, LABELS, PARAMETERS, VISION_INFO, BadMessage
from eventsrc.ros.named_classes import ClassNames, Named, nearest
from tests.support import ros_messages as ros
from tests.support.ros_messages import START

TOPIC = "/camera/detections"
NAMES = ["person", "", "chair"]
BY_ID = {"0": "person", "2": "chair"}


def told(*messages: Any) -> Named:
    names = ClassNames()
    for message in messages:
        names.add(message.__msgtype__, message)
    return names.of(TOPIC)


def parameters(**values: Any) -> Any:
    return ros.parameter_event("/camera/yolo", values)


@pytest.mark.parametrize(
    "values",
    [
        {"class_names": NAMES},
        {"model.labels": NAMES},
        {"id2label": '{"0": "person", "2": "chair"}'},
        {"label_map": ' ["person", "", "chair"]'},
        {"labels.0": "person", "labels.1": "", "labels.2": "chair", "rate": 5},
        {"names": ["others"], "class_names": NAMES, "frame": "{none}", "path": "[a"},
    ],
)
def test_a_parameter_names_classes(values: dict[str, Any]) -> None:
    assert told(parameters(**values)).labels == BY_ID


@pytest.mark.parametrize(
    "values",
    [
        {"classes": ["chair"]},  # a filter
        {"frame_names": ["a"]},
        {"labels": 3},
        {"labels": "none"},
        {"labels": "[1, 2]"},
        {"labels": '{"1": {"name": "chair"}}'},
        {"labels": "[" * 5000},
        {"17": "chair"},
    ],
)
def test_other_parameters_name_none(values: dict[str, Any]) -> None:
    assert told(parameters(**values)) == Named({})


def test_the_latest_message_counts() -> None:
    names = ClassNames()
    for event, is_news in (
        (parameters(labels=["a"]), True),
        (parameters(labels=["a"]), False),
        (ros.parameter_event("/camera/yolo", {"labels": ["b"]}, changed=True), True),
        (parameters(**{"more.labels.3": "c"}), True),
    ):
        assert names.add(PARAMETERS, event) == is_news
    assert names.of(TOPIC) == Named({"0": "b"}, "labels of /camera/yolo")
    assert names.add(LABELS, ros.label_info(START, {17: "chair", 3: ""}))
    assert names.of(TOPIC) == Named({"17": "chair"}), "of a LabelInfo before any parameter"


def test_of_several_nodes_the_nearest_counts_and_doubt_names_none() -> None:
    far = ros.parameter_event("/arm/labeller", {"labels": ["x"]})
    assert told(far).by == "labels of /arm/labeller"
    assert told(far, parameters(labels=NAMES)).by == "labels of /camera/yolo"
    twin = ros.parameter_event("/camera/other", {"labels": NAMES})
    assert told(twin, parameters(labels=NAMES)).labels == BY_ID, "both say the same"
    unlike = ros.parameter_event("/camera/other", {"labels": ["x"]})
    named = told(unlike, parameters(labels=NAMES))
    assert (named.labels, named.doubt) == (
        {},
        "several nodes name classes, labels of /camera/other and labels of /camera/yolo",
    )


@pytest.mark.parametrize(
    "location",
    ["/camera/yolo/class_labels_12", "class_labels_12", "yolo/class_labels_12"],
)
def test_a_vision_info_says_which_parameter_it_is(location: str) -> None:
    info = ros.vision_info(START, location)
    event = parameters(class_labels_12=NAMES, labels=["x"])
    for messages in ((info, event), (event, info)):
        assert told(*messages) == Named(BY_ID, "class_labels_12 of /camera/yolo")


def test_a_vision_info_of_a_file_names_nothing_itself() -> None:
    info = ros.vision_info(START, "/opt/coco.xml")
    assert told(info).doubt == "no parameter '/opt/coco.xml', which a VisionInfo names"
    assert told(info, parameters(labels=NAMES)).labels == BY_ID


def test_what_is_no_such_message_is_refused() -> None:
    names = ClassNames()
    for type_name in (LABELS, VISION_INFO, PARAMETERS, DETECTIONS):
        with pytest.raises(BadMessage):
            names.add(type_name, SimpleNamespace())
    assert names.of(TOPIC) == Named({})


def test_parameters_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("eventsrc.ros.named_classes._MOST_KEPT", 2)
    names = ClassNames()
    names.add(PARAMETERS, parameters(labels=["a"], others=["b"]))
    with pytest.raises(BadMessage, match="more than 2 parameters"):
        names.add(PARAMETERS, parameters(third=["c"]))
    assert names.add(PARAMETERS, parameters(labels=["d"])), "a known one is still followed"


def test_nearest_names() -> None:
    assert nearest("/a/b/detections", ["/a/x", "/a/b/y", "/z"]) == ["/a/b/y"]
    assert nearest("/detections", ["/far/x", "/x", "/y"]) == ["/x", "/y"]
    assert nearest("/detections", []) == []
