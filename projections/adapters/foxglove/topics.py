"""The topics that a map is shown on, for a recording and for a server.

| topic | message | what |
|---|---|---|
| ``/mapfold/map`` | foxglove.SceneUpdate | the whole map (`map_scene`) |
| ``/mapfold/walls`` | foxglove.Grid | an occupancy map; of a floor: ``/mapfold/walls/FLOOR`` |
| ``/mapfold/changes`` | foxglove.Log | one line for each change of the map |
| ``/mapfold/state`` | JSON | counts of the map, and the number of events it is of |
| ``/tf`` | foxglove.FrameTransforms | ``map`` → ``base_link``: the robot |
| an event's key | JSON | the event, as it is in the log |
| a message's topic | its own | a verbatim message; one on ``/tf`` is on ``/recorded/tf`` |

Every scene is whole: it begins by deleting what was shown. After a seek Foxglove shows the last
message of each topic, so a scene with only the changes would leave the rest out.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, Final, TypedDict

from foxglove import Channel, Context, Schema, messages
from foxglove.channels import FrameTransformsChannel, GridChannel, LogChannel, SceneUpdateChannel

from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import Event, MessageFormat
from eventsrc.log.channels import schema_of
from projections.adapters.scene import (
    Point,
    ShownPlace,
    Way,
    objects_of,
    place_colour,
    places_of,
    robot_of,
    thinned,
    ways_of,
)
from projections.fold.deltas import MapGiven, PlaceOrdinal, PlacesMerged
from projections.fold.deltas import Pose as MapPose
from projections.map.fold import format_of
from projections.map.view import MapView

ROBOT_FRAME: Final = "base_link"
_ANY_OBJECT: Final = {"type": "object", "properties": {}}
"""The JSON schema of states: Foxglove shows all fields of a message, but refuses a schema without
properties."""

_OWN_TOPICS: Final = ("/tf",)
_RECORDED: Final = "/recorded"
"""Prefix of the topic of a verbatim message that clashes with one of ours."""


class MapTopics:
    """Publishes to whatever sinks ``context`` has; Objects that are not confirmed only with
    ``everything``."""

    def __init__(self, context: Context, *, everything: bool) -> None:
        self._everything = everything
        self._context = context
        self._scene = SceneUpdateChannel("/mapfold/map", context=context)
        self._changes = LogChannel("/mapfold/changes", context=context)
        self._robot = FrameTransformsChannel("/tf", context=context)
        self._state = Channel(
            "/mapfold/state", message_encoding="json", schema=_ANY_OBJECT, context=context
        )
        self._walls: dict[str | None, GridChannel] = {}
        self._events: dict[tuple[str, MessageFormat | None], Channel] = {}

    def declare(
        self, topics: Iterable[tuple[str, MessageFormat | None]], floors: Iterable[str | None]
    ) -> None:
        """Make the topics of these keys and formats, and of these floors' occupancy maps before
        they are needed: a client that subscribes to a topic of a running server as soon as it
        appears may be refused."""
        for key, form in topics:
            self._event_topic(key, form)
        for floor in floors:
            self._walls_topic(floor)

    def event(self, event: Event, time_ns: int) -> None:
        """An event of the log, verbatim, on a topic of its key's name."""
        self._event_topic(event.key, format_of(event)).log(event.payload, log_time=time_ns)

    def _event_topic(self, key: str, form: MessageFormat | None) -> Channel:
        if (key, form) not in self._events:
            self._events[key, form] = self._new_topic(key, form)
        return self._events[key, form]

    def _new_topic(self, key: str, form: MessageFormat | None) -> Channel:
        if form is None:
            name, text = schema_of(key)
            ours = Schema(name=name, encoding="jsonschema", data=text)
            return Channel(key, message_encoding="json", schema=ours, context=self._context)
        schema = Schema(name=form.schema, encoding=form.schema_encoding, data=form.schema_text)
        return Channel(
            f"{_RECORDED}{key}" if key in _OWN_TOPICS else key,
            message_encoding=form.encoding,
            schema=schema,
            context=self._context,
        )

    def changes(self, lines: Iterable[str], time_ns: int) -> None:
        """The changes of the map, a message for each line."""
        for line in lines:
            message = messages.Log(
                timestamp=timestamp(time_ns),
                level=messages.LogLevel.Info,
                name="mapfold",
                message=line,
            )
            self._changes.log(message, log_time=time_ns)

    def robot(self, view: MapView, time_ns: int) -> None:
        """The robot's pose at the latest keyframe that has one."""
        latest = robot_of(view)
        if latest is not None and latest.pose is not None:
            transform = _transform(latest.pose, height(view, latest.floor), time_ns)
            self._robot.log(messages.FrameTransforms(transforms=[transform]), log_time=time_ns)

    def scene(
        self, view: MapView, merges: Sequence[PlacesMerged], time_ns: int, **state: Any
    ) -> None:
        """The whole map and its counts; ``state`` is added to these."""
        scene = map_scene(view, merges, time_ns, everything=self._everything)
        self._scene.log(scene, log_time=time_ns)
        self._state.log({"offset": view.next_offset, **state, **view.counts()}, log_time=time_ns)

    def walls(self, view: MapView, given: MapGiven, time_ns: int) -> None:
        """An occupancy map, at the height of its floor."""
        floor = given.map.floor
        grid = _grid(given.map, height(view, floor), time_ns)
        self._walls_topic(floor).log(grid, log_time=time_ns)

    def _walls_topic(self, floor: str | None) -> GridChannel:
        if floor not in self._walls:
            topic = "/mapfold/walls" if floor is None else f"/mapfold/walls/{floor}"
            self._walls[floor] = GridChannel(topic, context=self._context)
        return self._walls[floor]


def _transform(pose: MapPose, z: float, time_ns: int) -> messages.FrameTransform:
    return messages.FrameTransform(
        timestamp=timestamp(time_ns),
        parent_frame_id=FRAME,
        child_frame_id=ROBOT_FRAME,
        translation=messages.Vector3(x=pose.x_m, y=pose.y_m, z=z),
        rotation=_turned(pose.yaw_rad),
    )


def _turned(yaw: float) -> messages.Quaternion:
    return messages.Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def _grid(source: OccupancyMap, z: float, time_ns: int) -> messages.Grid:
    x, y, yaw = source.origin
    return messages.Grid(
        timestamp=timestamp(time_ns),
        frame_id=FRAME,
        pose=messages.Pose(position=messages.Vector3(x=x, y=y, z=z), orientation=_turned(yaw)),
        column_count=source.width,
        cell_size=messages.Vector2(x=source.resolution, y=source.resolution),
        row_stride=source.width,
        cell_stride=1,
        fields=[
            messages.PackedElementField(
                name="occupancy", offset=0, type=messages.PackedElementFieldNumericType.Uint8
            )
        ],
        data=source.cells.tobytes(),
    )


FRAME: Final = "map"
FLOOR_M: Final = 3.0
"""Height of a floor above the one before, in the order in which the log met them."""
_SECOND_NS: Final = 1_000_000_000
_INK: Final = messages.Color(r=0.15, g=0.15, b=0.18, a=1.0)
_GREY: Final = messages.Color(r=0.45, g=0.45, b=0.5, a=0.8)
_RED: Final = messages.Color(r=0.85, g=0.1, b=0.15, a=0.9)


def timestamp(time_ns: int) -> messages.Timestamp:
    """Foxglove's form of a time; before 1970 there is none, so 1970 is as early as it gets."""
    return messages.Timestamp(sec=max(time_ns, 0) // _SECOND_NS, nsec=max(time_ns, 0) % _SECOND_NS)


def map_scene(
    view: MapView, merges: Iterable[PlacesMerged], time_ns: int, *, everything: bool
) -> messages.SceneUpdate:
    """Places with outline and name, confirmed Objects or with ``everything`` all, adjacency, the
    path of each run, and a mark where each of ``merges`` happened; entities in that order, those of
    a kind by ordinal."""
    now = timestamp(time_ns)
    places = places_of(view)
    parts = [*_places(view, places), *_objects(view, everything=everything)]
    parts += [*_ways(view, ways_of(view, places)), *_paths(view), *_merges(view, merges)]
    return messages.SceneUpdate(
        deletions=[
            messages.SceneEntityDeletion(timestamp=now, type=messages.SceneEntityDeletionType.All)
        ],
        entities=[
            messages.SceneEntity(timestamp=now, frame_id=FRAME, id=name, **shapes)
            for name, shapes in parts
        ],
    )


class _Shapes(TypedDict, total=False):
    """Fields of an entity."""

    metadata: list[messages.KeyValuePair]
    cubes: list[messages.CubePrimitive]
    spheres: list[messages.SpherePrimitive]
    lines: list[messages.LinePrimitive]
    triangles: list[messages.TriangleListPrimitive]
    texts: list[messages.TextPrimitive]


_Part = tuple[str, _Shapes]
"""An entity's id and its fields."""


def _places(view: MapView, places: Iterable[ShownPlace]) -> Iterator[_Part]:
    for shown in places:
        place, z = shown.record, height(view, shown.floor)
        colour = _colour(place.ordinal)
        corners = [messages.Point3(x=x, y=y, z=z) for x, y in shown.hull]
        shapes: _Shapes = {
            "metadata": _metadata(
                place_id=place.place_id, keyframes=place.keyframe_count, name=place.name
            ),
            "texts": [_text(shown.label, shown.centroid, z + 0.3, 0.35)],
        }
        if shown.outlines:
            shapes["lines"] = [
                messages.LinePrimitive(
                    type=messages.LinePrimitiveLineType.LineStrip,
                    pose=_at(0.0, 0.0, 0.0),
                    thickness=0.05,
                    points=[messages.Point3(x=x, y=y, z=z) for x, y in ring],
                    color=colour,
                )
                for ring in shown.outlines
            ]
        if shown.region is None and corners:
            fan = [i for corner in range(1, len(corners) - 1) for i in (0, corner, corner + 1)]
            shapes["triangles"] = [
                messages.TriangleListPrimitive(
                    pose=_at(0.0, 0.0, 0.0),
                    points=corners,
                    indices=fan,
                    color=_colour(place.ordinal, 0.3),
                )
            ]
        if not shown.outlines:
            shapes["spheres"] = [
                messages.SpherePrimitive(
                    pose=_at(*shown.centroid, z),
                    size=messages.Vector3(x=0.3, y=0.3, z=0.3),
                    color=colour,
                )
            ]
        yield f"place/{place.place_id}", shapes


def _objects(view: MapView, *, everything: bool) -> Iterator[_Part]:
    for shown in objects_of(view, everything=everything):
        found, missing = shown.record, shown.missing
        z = height(view, shown.floor) + 0.2
        colour = _GREY if found.place is None else _colour(found.place)
        yield (
            f"object/{found.object_id}",
            {
                "metadata": _metadata(
                    object_id=found.object_id,
                    class_name=found.class_name,
                    observations=found.obs_count,
                    place_id=view.place_id(found.place),
                    sigma_m=None if found.estimate is None else found.estimate.est_sigma_m,
                    missing=True if missing else None,
                ),
                "cubes": [
                    messages.CubePrimitive(
                        pose=_at(*found.spot, z),
                        size=messages.Vector3(x=0.2, y=0.2, z=0.2),
                        color=_RED if missing else colour,
                    )
                ],
                "texts": [_text(shown.label, found.spot, z + 0.25, 0.18)],
            },
        )


def _ways(view: MapView, ways: Iterable[Way]) -> Iterator[_Part]:
    lines: list[messages.LinePrimitive] = []
    for way in ways:
        points = [
            messages.Point3(x=end.centroid[0], y=end.centroid[1], z=height(view, end.floor))
            for end in way.ends
        ]
        lines.append(
            messages.LinePrimitive(
                type=messages.LinePrimitiveLineType.LineStrip,
                pose=_at(0.0, 0.0, 0.1),
                thickness=min(0.05 * way.transitions, 0.25),
                points=points,
                color=_INK,
            )
        )
    if lines:
        yield "adjacency", {"lines": lines}


def _paths(view: MapView) -> Iterator[_Part]:
    points: dict[str, list[messages.Point3]] = {run.run_id: [] for run in view.runs}
    for k in view.keyframes:
        if k.pose is not None:
            z = height(view, k.floor)
            points[k.run_id].append(messages.Point3(x=k.pose.x_m, y=k.pose.y_m, z=z))
    for run_id, path in points.items():
        if len(path) > 1:
            line = messages.LinePrimitive(
                type=messages.LinePrimitiveLineType.LineStrip,
                pose=_at(0.0, 0.0, 0.05),
                thickness=0.03,
                points=[*thinned(path)],
                color=_GREY,
            )
            yield f"path/{run_id}", {"lines": [line]}


def _merges(view: MapView, merges: Iterable[PlacesMerged]) -> Iterator[_Part]:
    for merge in merges:
        bridge = view.keyframes[merge.bridge]
        if bridge.pose is None:
            continue
        absorbed = ", ".join(view.all_places[place].place_id for place in merge.absorbed)
        label = f"{absorbed} → {view.place_id(merge.survivor)}"
        where = bridge.pose.x_m, bridge.pose.y_m
        z = height(view, bridge.floor) + 0.1
        yield (
            f"merge/{merge.offset}",
            {
                "metadata": _metadata(
                    offset=merge.offset, bridge=f"{bridge.run_id}:{bridge.keyframe_id}"
                ),
                "spheres": [
                    messages.SpherePrimitive(
                        pose=_at(*where, z), size=messages.Vector3(x=0.3, y=0.3, z=0.3), color=_RED
                    )
                ],
                "texts": [_text(label, where, z + 0.3, 0.2)],
            },
        )


def height(view: MapView, floor: str | None) -> float:
    """The height at which a floor is shown, metres; that of poses without a floor's name is 0."""
    return 0.0 if floor is None else FLOOR_M * view.floors.get(floor, 0)


def _colour(place: PlaceOrdinal, alpha: float = 1.0) -> messages.Color:
    colour = place_colour(place)
    red, green, blue = (int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5))
    return messages.Color(r=red, g=green, b=blue, a=alpha)


def _at(x: float, y: float, z: float) -> messages.Pose:
    return messages.Pose(
        position=messages.Vector3(x=x, y=y, z=z),
        orientation=messages.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0),
    )


def _text(text: str, where: Point, z: float, size: float) -> messages.TextPrimitive:
    return messages.TextPrimitive(
        pose=_at(*where, z), billboard=True, font_size=size, color=_INK, text=text
    )


def _metadata(**values: object) -> list[messages.KeyValuePair]:
    return [messages.KeyValuePair(key=k, value=str(v)) for k, v in values.items() if v is not None]
