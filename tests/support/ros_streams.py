"""Messages of ROS and the envelopes that an assembler makes of them."""

import json
from collections.abc import Iterable
from typing import Any

from eventsrc.ros.assembler import Assembler, RosMessage
from eventsrc.ros.stream import Stream
from eventsrc.ros.transforms import Transform
from tests.support import ros_messages as ros
from tests.support.ros_messages import OPTICAL, SECOND, START, flat

MS = SECOND // 1000


BASE_TO_CAMERA = flat(0.25, 0.0, 0.0, 0.3)


TYPES = {
    "/detections": "vision_msgs/msg/Detection2DArray",
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/odom": "nav_msgs/msg/Odometry",
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/camera_info": "sensor_msgs/msg/CameraInfo",
    "/embeddings": "std_msgs/msg/String",
    "/floats": "std_msgs/msg/Float32MultiArray",
    "/label_info": "vision_msgs/msg/LabelInfo",
}


CUP = ros.detection([("cup", 0.9)], ros.box(100.0, 50.0, 20.0, 10.0))


def stream(**more: Any) -> Stream:
    return Stream(**{"detections": "/detections", "run_id": "r", **more})


def message(topic: str, received_ms: int, content: Any) -> RosMessage:
    return RosMessage(topic, TYPES[topic], START + received_ms * MS, content)


def picture(at_ms: int, *each: Any, frame: str = "optical", received_ms: int | None = None):
    received = at_ms if received_ms is None else received_ms
    return message("/detections", received, ros.detections(START + at_ms * MS, frame, *each))


def moving(at_ms: int, parent: str, child: str, t: Transform, received_ms: int | None = None):
    content = ros.tf(ros.transform(parent, child, START + at_ms * MS, t))
    return message("/tf", at_ms if received_ms is None else received_ms, content)


def static() -> RosMessage:
    links = [
        ros.transform("base_link", "camera", 0, BASE_TO_CAMERA),
        ros.transform("camera", "optical", 0, OPTICAL),
    ]
    return message("/tf_static", 0, ros.tf(*links))


def run(messages: Iterable[RosMessage], *streams: Stream) -> tuple[list[Any], Assembler[Any]]:
    """The envelopes, as JSON, and the assembler."""
    assembler: Assembler[Any] = Assembler(streams or (stream(),))
    made = [each for one in messages for each in assembler.add(one)] + assembler.finish()
    return [json.loads(each.payload) for each in made], assembler
