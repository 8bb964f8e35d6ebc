"""Types of messages, of which the definitions may come from a stranger's bag."""

import builtins
from typing import Any

import pytest

from eventsrc.ros.library import MessageTypes, NoRosbags, Undecodable
from tests.support import ros_messages as ros
from tests.support.ros_messages import START, flat

LINE = "=" * 80
NAMES = (
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/OccupancyGrid",
    "sensor_msgs/msg/CameraInfo",
    "std_msgs/msg/Float32MultiArray",
    "std_msgs/msg/String",
    "tf2_msgs/msg/TFMessage",
    "vision_msgs/msg/Detection2DArray",
)


def test_every_type_that_is_used_is_known_and_reads_its_own_definition() -> None:
    types = MessageTypes()
    for name in NAMES:
        text = types.definition(name)
        types.define(name, text)
        assert types.definition(name) == text


def test_a_message_survives_encoding_in_both_byte_orders() -> None:
    message = ros.tf(ros.transform("map", "base", START, flat(1.0, 2.0, 0.5)))
    name = "tf2_msgs/msg/TFMessage"
    assert ros.TYPES.decode(ros.TYPES.encode(message, name), name) == message
    big = bytes(ros.TYPES._store.serialize_cdr(message, name, little_endian=False))
    assert ros.TYPES.decode(big, name) == message


def test_a_bags_own_definition_replaces_another() -> None:
    types = MessageTypes()
    types.define("std_msgs/msg/String", "string data\nint32 more\n")
    made = types.make("std_msgs/msg/String", data="a", more=3)
    payload = types.encode(made, "std_msgs/msg/String")
    assert types.decode(payload, "std_msgs/msg/String").more == 3
    assert not hasattr(MessageTypes().make("std_msgs/msg/String", data="a"), "more")


@pytest.mark.parametrize("is_several", [False, True])
def test_a_definition_in_idl_is_read(is_several: bool) -> None:
    idl = "module a { module msg { struct B { double x; sequence<double> y; }; }; };"
    types = MessageTypes()
    types.define("a/msg/B", f"{LINE}\nIDL: a/msg/B\n{idl}" if is_several else idl, is_idl=True)
    assert types.definition("a/msg/B").split() == ["float64", "x", "float64[]", "y"]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a/msg/B", "% no definition"),
        ("a/msg/B", "int8 x\nstring __class__"),
        ("a/msg/B", f"C c\n{LINE}\nMSG: a/2C\nint8 x"),
        ("a/msg/B", f"2a/C c\n{LINE}\nMSG: 2a/C\nint8 x"),
        ("a/msg/B:\n    pass\nimport os; os.abort()\nclass C", "int8 x\n"),
        ("a/msg/B(os.abort())", "int8 x\n"),
        ("a/msg/B", "B" * 100_000),
        ("a/msg/B", "\0"),
    ],
)
def test_a_definition_that_defines_nothing_is_refused_in_one_line(name: str, text: str) -> None:
    types = MessageTypes()
    with pytest.raises(Undecodable) as refused:
        types.define(name, text)
    assert len(str(refused.value)) < len(name) + 220
    assert types.decode(ros.TYPES.encode(ros.text("x"), NAMES[5]), NAMES[5]).data == "x"


def test_a_definition_that_refers_to_nothing_is_found_when_it_is_used() -> None:
    types = MessageTypes()
    types.define("a/msg/B", "other_msgs/Unknown x\n")
    with pytest.raises(Undecodable):
        types.decode(b"\0\1\0\0" + bytes(64), "a/msg/B")


@pytest.mark.parametrize(
    "payload", [b"", b"\0", b"\0\1\0\0", b"\0\7\0\0" + bytes(9), b"\0\1\0\0\xff\xff\xff\xff" * 9]
)
def test_what_is_no_message_is_refused(payload: bytes) -> None:
    for name in NAMES:
        with pytest.raises(Undecodable):
            ros.TYPES.decode(payload, name)
    with pytest.raises(Undecodable, match="no such type"):
        ros.TYPES.decode(payload, "a/msg/Unknown")


def test_without_rosbags_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name.startswith("rosbags"):
            raise ImportError("No module named 'rosbags'")
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(NoRosbags, match=r"pip install 'mapfold\[ros\]'"):
        MessageTypes()
