"""Messages of ROS 2 as rosbags' objects, for tests."""

import base64
import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from eventsrc.ros.library import MessageTypes
from eventsrc.ros.transforms import Transform

TYPES = MessageTypes()
make = TYPES.make
SECOND = 1_000_000_000
START = 1_714_557_600 * SECOND


def stamp(ns: int) -> Any:
    return make("builtin_interfaces/msg/Time", sec=ns // SECOND, nanosec=ns % SECOND)


def header(ns: int, frame: str) -> Any:
    return make("std_msgs/msg/Header", stamp=stamp(ns), frame_id=frame)


def vector(kind: str, *xyz: float) -> Any:
    return make(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", map(float, xyz), strict=True)))


def quaternion(t: Transform) -> Any:
    return make("geometry_msgs/msg/Quaternion", x=t.qx, y=t.qy, z=t.qz, w=t.qw)


def flat(x: float, y: float, yaw: float, z: float = 0.0) -> Transform:
    """A pose on the ground."""
    return Transform(x, y, z, 0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))


OPTICAL = Transform(0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5)
"""From a body's frame (x ahead) to that of its camera's pictures (z ahead)."""


def transform(parent: str, child: str, ns: int, t: Transform) -> Any:
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=vector("Vector3", t.x, t.y, t.z),
            rotation=quaternion(t),
        ),
    )


def tf(*transforms: Any) -> Any:
    return make("tf2_msgs/msg/TFMessage", transforms=[*transforms])


def pose(t: Transform) -> Any:
    return make(
        "geometry_msgs/msg/Pose",
        position=vector("Point", t.x, t.y, t.z),
        orientation=quaternion(t),
    )


def six_by_six(xx: float, xy: float, yy: float, yaw: float) -> np.ndarray[Any, Any]:
    matrix = np.zeros((6, 6))
    matrix[:2, :2] = [[xx, xy], [xy, yy]]
    matrix[5, 5] = yaw
    return matrix.reshape(36)


def pose_with_covariance(ns: int, frame: str, t: Transform, covariance: Any = None) -> Any:
    values = np.zeros(36) if covariance is None else np.asarray(covariance, float)
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header=header(ns, frame),
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(t), covariance=values),
    )


def odometry(ns: int, frame: str, child: str, t: Transform, covariance: Any = None) -> Any:
    values = np.zeros(36) if covariance is None else np.asarray(covariance, float)
    nothing = make(
        "geometry_msgs/msg/Twist",
        linear=vector("Vector3", 0, 0, 0),
        angular=vector("Vector3", 0, 0, 0),
    )
    return make(
        "nav_msgs/msg/Odometry",
        header=header(ns, frame),
        child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose(t), covariance=values),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=nothing, covariance=np.zeros(36)),
    )


def box(x: float, y: float, width: float, height: float, theta: float = 0.0) -> Any:
    point = make("vision_msgs/msg/Point2D", x=x, y=y)
    center = make("vision_msgs/msg/Pose2D", position=point, theta=theta)
    return make("vision_msgs/msg/BoundingBox2D", center=center, size_x=width, size_y=height)


def detection(results: Sequence[tuple[str, float]], bbox: Any, id_: str = "") -> Any:
    nowhere = make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=pose(flat(0.0, 0.0, 0.0)),
        covariance=np.zeros(36),
    )
    return make(
        "vision_msgs/msg/Detection2D",
        header=header(0, ""),
        results=[
            make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=make("vision_msgs/msg/ObjectHypothesis", class_id=name, score=score),
                pose=nowhere,
            )
            for name, score in results
        ],
        bbox=bbox,
        id=id_,
    )


def solid(name: str, t: Transform, *size: float) -> Any:
    """A Detection3D."""
    (result,) = detection([(name, 0.8)], box(0, 0, 0, 0)).results
    bbox = make("vision_msgs/msg/BoundingBox3D", center=pose(t), size=vector("Vector3", *size))
    made = {"header": header(0, ""), "results": [result], "bbox": bbox, "id": ""}
    return make("vision_msgs/msg/Detection3D", **made)


def solids(ns: int, frame: str, *each: Any) -> Any:
    return make("vision_msgs/msg/Detection3DArray", header=header(ns, frame), detections=[*each])


def laser_scan(ns: int, frame: str, ranges: Any, **fields: Any) -> Any:
    about = {"range_min": 0.1, "range_max": 8.0, "angle_max": 1.0, **fields}
    return make(
        "sensor_msgs/msg/LaserScan",
        header=header(ns, frame),
        time_increment=0.0,
        scan_time=0.1,
        ranges=np.array(ranges, np.float32),
        intensities=np.zeros(0, np.float32),
        **about,
    )


def detections(ns: int, frame: str, *each: Any) -> Any:
    return make("vision_msgs/msg/Detection2DArray", header=header(ns, frame), detections=[*each])


def camera_info(ns: int, frame: str, fx: float, width: int = 640, height: int = 480) -> Any:
    k = np.array([fx, 0.0, width / 2, 0.0, fx, height / 2, 0.0, 0.0, 1.0])
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header(ns, frame),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=k,
        r=np.eye(3).reshape(9),
        p=np.zeros(12),
        binning_x=0,
        binning_y=0,
        roi=make(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=0,
            y_offset=0,
            height=0,
            width=0,
            do_rectify=False,
        ),
    )


def label_info(ns: int, names: dict[int, str]) -> Any:
    classes = [
        make("vision_msgs/msg/VisionClass", class_id=number, class_name=name)
        for number, name in names.items()
    ]
    return make(
        "vision_msgs/msg/LabelInfo", header=header(ns, ""), class_map=classes, threshold=0.5
    )


def vision_info(ns: int, location: str) -> Any:
    """Says where the names of classes are."""
    return make(
        "vision_msgs/msg/VisionInfo",
        header=header(ns, ""),
        method="yolo",
        database_location=location,
        database_version=1,
    )


def parameter_event(node: str, values: dict[str, Any], *, changed: bool = False) -> Any:
    """A node announces parameters: texts, lists of texts, and whole numbers."""
    nothing = np.zeros(0)
    made = [
        make(
            "rcl_interfaces/msg/Parameter",
            name=name,
            value=make(
                "rcl_interfaces/msg/ParameterValue",
                type={str: 4, list: 9, int: 2}[type(value)],
                bool_value=False,
                integer_value=value if isinstance(value, int) else 0,
                double_value=0.0,
                string_value=value if isinstance(value, str) else "",
                byte_array_value=nothing.astype(np.uint8),
                bool_array_value=nothing.astype(np.bool_),
                integer_array_value=nothing.astype(np.int64),
                double_array_value=nothing,
                string_array_value=value if isinstance(value, list) else [],
            ),
        )
        for name, value in values.items()
    ]
    return make(
        "rcl_interfaces/msg/ParameterEvent",
        stamp=stamp(START),
        node=node,
        new_parameters=[] if changed else made,
        changed_parameters=made if changed else [],
        deleted_parameters=[],
    )


def text(data: str) -> Any:
    return make("std_msgs/msg/String", data=data)


def base64_of(vector_: Sequence[float]) -> str:
    return base64.b64encode(np.asarray(vector_, "<f4").tobytes()).decode()


def embeddings(ns: int, vectors: Any, model: str | None = "m") -> Any:
    """As JSON; ``vectors`` are a list, or a dict by Detection2D.id."""
    given = (
        {name: None if each is None else base64_of(each) for name, each in vectors.items()}
        if isinstance(vectors, dict)
        else [None if each is None else base64_of(each) for each in vectors]
    )
    at = {"sec": ns // SECOND, "nanosec": ns % SECOND}
    return text(json.dumps({"stamp": at, "model": model, "embeddings": given}))


def float_rows(ns: int, rows: Sequence[Sequence[float]], model: str = "m") -> Any:
    values = np.asarray(rows, np.float32)
    sizes = zip((f"{ns // SECOND}.{ns % SECOND:09d}", model), values.shape, strict=True)
    dim = [
        make("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=0)
        for label, size in sizes
    ]
    layout = make("std_msgs/msg/MultiArrayLayout", dim=dim, data_offset=0)
    return make("std_msgs/msg/Float32MultiArray", layout=layout, data=values.reshape(-1))


def grid(ns: int, cells: Sequence[int], width: int, height: int) -> Any:
    return make(
        "nav_msgs/msg/OccupancyGrid",
        header=header(ns, "map"),
        info=make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=stamp(0),
            resolution=0.5,
            width=width,
            height=height,
            origin=pose(flat(-1.0, -2.0, 0.0)),
        ),
        data=np.asarray(cells, np.int8),
    )
