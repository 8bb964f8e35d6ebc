"""The map as messages of ROS 2: markers for RViz, detections, an occupancy grid.

Markers are incremental: each has a namespace and an id of its own, and `changed_markers` are those
that differ from the ones shown before, with a DELETE for each that is gone. Their stamps are 0, so
RViz shows them in the frame ``map`` at any time. `ShownMap` publishes each when it changed.
"""

import itertools
import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from eventsrc.envelope.occupancy_map import UNKNOWN, OccupancyMap
from eventsrc.record.ros_node import RosNode, RosPublisher
from eventsrc.ros.library import MessageTypes
from projections.adapters.scene import (
    ShownObject,
    ShownPlace,
    objects_of,
    place_colour,
    places_of,
    ways_of,
)
from projections.fold.deltas import MapGiven, PlaceOrdinal
from projections.map.records import body_fields
from projections.map.view import MapView

MARKERS: Final = "visualization_msgs/msg/MarkerArray"
DETECTIONS: Final = "vision_msgs/msg/Detection3DArray"
GRID: Final = "nav_msgs/msg/OccupancyGrid"
POSE: Final = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
FRAME: Final = "map"
_MARKER: Final = "visualization_msgs/msg/Marker"
_CUBE, _SPHERE, _LINE_LIST, _TEXT = 1, 2, 5, 9
_ADD, _DELETE = 0, 2
_GREY, _RED, _INK = (0.45, 0.45, 0.5), (0.85, 0.1, 0.15), (0.15, 0.15, 0.18)
_OBJECT_M: Final = 0.2
_FLOOR_M: Final = 3.0
"""Height of a floor above the one before, in the order in which the log met them."""
_NS: Final = 1_000_000_000
_Rgb = tuple[float, float, float]
MarkerKey = tuple[str, int]
"""A marker's namespace and id."""


class MapMessages:
    """Makes the messages; ``types`` are those of ROS."""

    def __init__(self, types: MessageTypes) -> None:
        self._types = types

    def markers(self, view: MapView) -> dict[MarkerKey, Any]:
        """Outline and name of each place, confirmed objects and their classes, and the ways between
        places."""
        places = places_of(view)
        made = [*self._places(view, places), *self._objects(view), *self._ways(view, places)]
        return {(marker.ns, marker.id): marker for marker in made}

    def changed(self, before: Mapping[MarkerKey, Any], now: Mapping[MarkerKey, Any]) -> list[Any]:
        """The markers that are new or differ, and one that deletes each that is gone."""
        gone = [self._marker(*key, 0, action=_DELETE) for key in before if key not in now]
        changed = [
            marker
            for key, marker in now.items()
            if key not in before or self._bytes(before[key]) != self._bytes(marker)
        ]
        return gone + changed

    def array(self, markers: Iterable[Any]) -> Any:
        """The markers as one message."""
        return self._types.make(MARKERS, markers=[*markers])

    def objects(self, view: MapView, stamp_ns: int) -> Any:
        """The confirmed objects, as detections in the frame ``map``. A score is the share of the
        keyframes that should show the object and do."""
        header, make = self._header(stamp_ns), self._types.make
        detections = []
        for shown in objects_of(view):
            if shown.missing:
                continue
            found = shown.record
            z, lengths = _body_of(view, shown)
            pose, size = self._pose(*found.spot, z), self._vector(*lengths)
            score = found.obs_count / (found.obs_count + found.misses)
            hypothesis = make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=make(
                    "vision_msgs/msg/ObjectHypothesis", class_id=found.class_name, score=score
                ),
                pose=self._pose_with(pose, _covariance_of(shown)),
            )
            box = make("vision_msgs/msg/BoundingBox3D", center=pose, size=size)
            detections.append(
                make(
                    "vision_msgs/msg/Detection3D",
                    header=header,
                    results=[hypothesis],
                    bbox=box,
                    id=found.object_id,
                )
            )
        return make(DETECTIONS, header=header, detections=detections)

    def grid(self, walls: OccupancyMap, stamp_ns: int) -> Any:
        """An occupancy map."""
        make = self._types.make
        x, y, yaw = walls.origin
        info = make(
            "nav_msgs/msg/MapMetaData",
            map_load_time=self._time(stamp_ns),
            resolution=walls.resolution,
            width=walls.width,
            height=walls.height,
            origin=self._pose(x, y, 0.0, yaw),
        )
        cells = np.where(walls.cells == UNKNOWN, -1, walls.cells.astype(np.int16)).astype(np.int8)
        return make(GRID, header=self._header(stamp_ns), info=info, data=cells.ravel())

    def pose(self, x: float, y: float, yaw: float, stamp_ns: int) -> Any:
        """A PoseStamped in the frame ``map``."""
        return self._types.make(
            POSE, header=self._header(stamp_ns), pose=self._pose(x, y, 0.0, yaw)
        )

    def pose_with_covariance(
        self, x: float, y: float, yaw: float, covariance: Sequence[float], stamp_ns: int
    ) -> Any:
        """A PoseWithCovarianceStamped in the frame ``map``; ``covariance`` has nine numbers, of x,
        y and yaw."""
        posed = self._pose_with(self._pose(x, y, 0.0, yaw), covariance)
        return self._types.make(POSE_WITH_COVARIANCE, header=self._header(stamp_ns), pose=posed)

    def _places(self, view: MapView, places: Iterable[ShownPlace]) -> Iterator[Any]:
        for shown in places:
            ordinal, z = int(shown.record.ordinal), _height(view, shown.floor)
            colour = _colour(shown.record.ordinal)
            yield self._text("place_names", ordinal, shown.label, (*shown.centroid, z + 0.3), 0.35)
            edges = [e for ring in shown.outlines for e in itertools.pairwise(ring)]
            if edges:
                ends = [(*end, z) for edge in edges for end in edge]
                yield self._lines("places", ordinal, ends, 0.05, colour)
            else:
                at = self._pose(*shown.centroid, z)
                yield self._marker("places", ordinal, _SPHERE, at, 0.3, colour)

    def _objects(self, view: MapView) -> Iterator[Any]:
        for shown in objects_of(view):
            found = shown.record
            ordinal, (z, size) = int(found.ordinal), _body_of(view, shown)
            colour = _GREY if found.place is None else _colour(found.place)
            at = self._pose(*found.spot, z)
            red = _RED if shown.missing else colour
            yield self._marker("objects", ordinal, _CUBE, at, size, red)
            above = *found.spot, z + size[2] / 2 + 0.15
            yield self._text("object_names", ordinal, shown.label, above, 0.18)

    def _ways(self, view: MapView, places: Iterable[ShownPlace]) -> Iterator[Any]:
        ends = [
            (*end.centroid, _height(view, end.floor) + 0.1)
            for way in ways_of(view, places)
            for end in way.ends
        ]
        if ends:
            yield self._lines("ways", 0, ends, 0.03, _INK)

    def _text(
        self, ns: str, number: int, text: str, at: tuple[float, float, float], size: float
    ) -> Any:
        return self._marker(ns, number, _TEXT, self._pose(*at), size, _INK, text=text)

    def _lines(
        self,
        ns: str,
        number: int,
        ends: Iterable[tuple[float, float, float]],
        width: float,
        colour: _Rgb,
    ) -> Any:
        point = "geometry_msgs/msg/Point"
        points = [self._types.make(point, x=x, y=y, z=z) for x, y, z in ends]
        return self._marker(ns, number, _LINE_LIST, None, width, colour, points=points)

    def _marker(
        self,
        ns: str,
        number: int,
        kind: int,
        pose: Any = None,
        size: float | tuple[float, float, float] = 0.0,
        colour: _Rgb = _INK,
        *,
        text: str = "",
        points: Sequence[Any] = (),
        action: int = _ADD,
    ) -> Any:
        make, empty = self._types.make, np.zeros(0, np.uint8)
        header = self._header(0)
        return make(
            _MARKER,
            header=header,
            ns=ns,
            id=number,
            type=kind,
            action=action,
            pose=self._pose(0.0, 0.0, 0.0) if pose is None else pose,
            scale=self._vector(*(size if isinstance(size, tuple) else (size,) * 3)),
            color=self._types.make(
                "std_msgs/msg/ColorRGBA", **dict(zip("rgb", colour, strict=True)), a=1.0
            ),
            lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
            frame_locked=False,
            points=[*points],
            colors=[],
            texture_resource="",
            texture=make("sensor_msgs/msg/CompressedImage", header=header, format="", data=empty),
            uv_coordinates=[],
            text=text,
            mesh_resource="",
            mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=empty),
            mesh_use_embedded_materials=False,
        )

    def _bytes(self, marker: Any) -> bytes:
        return self._types.encode(marker, _MARKER)

    def _header(self, stamp_ns: int) -> Any:
        return self._types.make("std_msgs/msg/Header", stamp=self._time(stamp_ns), frame_id=FRAME)

    def _time(self, stamp_ns: int) -> Any:
        return self._types.make(
            "builtin_interfaces/msg/Time", sec=stamp_ns // _NS, nanosec=stamp_ns % _NS
        )

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _pose(self, x: float, y: float, z: float, yaw: float = 0.0) -> Any:
        make = self._types.make
        turned = make(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)
        )
        at = make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        return make("geometry_msgs/msg/Pose", position=at, orientation=turned)

    def _pose_with(self, pose: Any, covariance: Sequence[float]) -> Any:
        whole = np.zeros((6, 6))
        whole[np.ix_((0, 1, 5), (0, 1, 5))] = np.reshape(covariance, (3, 3))
        return self._types.make(
            "geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=whole.ravel()
        )


def _covariance_of(shown: ShownObject) -> Sequence[float]:
    """Of x, y and a yaw that is not known; zeros, which mean unknown, without an estimate."""
    at = shown.record.estimate
    if at is None:
        return [0.0] * 9
    xx, xy, yy = (value / 1e12 for value in (at.var_xx_um2, at.var_xy_um2, at.var_yy_um2))
    return [xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, math.pi**2]


def _body_of(view: MapView, shown: ShownObject) -> tuple[float, tuple[float, float, float]]:
    """The height of an object's middle, and its length, width and height, in metres; without a
    measured one it is a cube of `_OBJECT_M` on the floor."""
    body = body_fields(view.body_of(shown.record))
    length, width, high = body.get("size", (_OBJECT_M,) * 3)
    return _height(view, shown.floor) + body.get("z", high / 2), (length, width, high)


def _height(view: MapView, floor: str | None) -> float:
    return 0.0 if floor is None else _FLOOR_M * view.floors.get(floor, 0)


def _colour(place: PlaceOrdinal) -> _Rgb:
    red, green, blue = (int(place_colour(place)[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return red, green, blue


class ShownMap:
    """Publishes maps on ``~/markers``, ``~/objects`` and, once there are walls, ``~/walls``.

    Subscribers that are there get the markers that changed, late ones all of them. Of several
    floors the walls of the first are shown.
    """

    def __init__(self, node: RosNode) -> None:
        self._node, self._messages = node, MapMessages(node.types)
        self._markers = node.publisher("~/markers", MARKERS, latched=True)
        self._objects = node.publisher("~/objects", DETECTIONS, latched=True)
        self._walls: RosPublisher | None = None
        self._shown: Mapping[MarkerKey, Any] | None = None
        self._given: MapGiven | None = None

    @property
    def topics(self) -> list[str]:
        """The topics that are published on."""
        there = (self._markers, self._objects, self._walls)
        return [each.topic for each in there if each is not None]

    def show(self, view: MapView) -> int:
        """Publish what differs from the map before; returns how many markers do."""
        messages, stamp_ns = self._messages, time.time_ns()
        markers = messages.markers(view)
        changed = messages.changed(self._shown or {}, markers)
        if changed or self._shown is None:
            whole = messages.array(markers.values())
            self._markers.publish(messages.array(changed), kept=whole)
        self._objects.publish(messages.objects(view, stamp_ns))
        self._shown = markers
        if view.map is not None and view.map != self._given:
            if self._walls is None:
                self._walls = self._node.publisher("~/walls", GRID, latched=True)
            self._walls.publish(messages.grid(view.map.map, stamp_ns))
            self._given = view.map
        return len(changed)
