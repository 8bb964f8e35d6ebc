"""The topics that a map is shown on, for a recording and for a server.

| topic | message | what |
|---|---|---|
| ``/mapfold/map`` | foxglove.SceneUpdate | the whole map (`scene`) |
| ``/mapfold/walls`` | foxglove.Grid | an occupancy map; of a floor: ``/mapfold/walls/FLOOR`` |
| ``/mapfold/changes`` | foxglove.Log | one line for each change of the map |
| ``/mapfold/state`` | JSON | counts of the map, and the number of events it is of |
| ``/tf`` | foxglove.FrameTransforms | ``map`` → ``base_link``: the robot |
| an event's key | JSON | the event, as it is in the log |
| a message's topic | its own | a verbatim message; one on ``/tf`` is on ``/recorded/tf`` |
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Final

from foxglove import Channel, Context, Schema
from foxglove.channels import (
    FrameTransformsChannel,
    GridChannel,
    LogChannel,
    SceneUpdateChannel,
)
from foxglove.messages import (
    FrameTransform,
    FrameTransforms,
    Grid,
    Log,
    LogLevel,
    PackedElementField,
    PackedElementFieldNumericType,
    Pose,
    Quaternion,
    Vector2,
    Vector3,
)

from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.log import Event, MessageFormat
from eventsrc.log.format import schema_of
from projections.fold.deltas import MapGiven, PlacesMerged
from projections.fold.deltas import Pose as MapPose
from projections.map.scenes import format_of
from projections.map.view import MapView

from .scene import FRAME, height, map_scene, timestamp

ROBOT_FRAME: Final = "base_link"
_ANY_OBJECT: Final = {"type": "object", "properties": {}}
"""The JSON schema of states: Foxglove shows all fields of a message, but refuses a schema without
properties."""

_OWN_TOPICS: Final = ("/tf",)
_RECORDED: Final = "/recorded"
"""Prefix of the topic of a verbatim message that clashes with one of ours."""


class MapTopics:
    """Publishes to whatever sinks ``context`` has."""

    def __init__(self, context: Context) -> None:
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
            message = Log(
                timestamp=timestamp(time_ns), level=LogLevel.Info, name="mapfold", message=line
            )
            self._changes.log(message, log_time=time_ns)

    def robot(self, view: MapView, time_ns: int) -> None:
        """The robot's pose at the latest keyframe that has one."""
        posed = (k for k in reversed(view.keyframes) if k.pose is not None)
        latest = next(posed, None)
        if latest is not None and latest.pose is not None:
            transform = _transform(latest.pose, height(view, latest.floor), time_ns)
            self._robot.log(FrameTransforms(transforms=[transform]), log_time=time_ns)

    def scene(
        self, view: MapView, merges: Sequence[PlacesMerged], time_ns: int, **state: Any
    ) -> None:
        """The whole map and its counts; ``state`` is added to these."""
        self._scene.log(map_scene(view, merges, time_ns), log_time=time_ns)
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


def _transform(pose: MapPose, z: float, time_ns: int) -> FrameTransform:
    return FrameTransform(
        timestamp=timestamp(time_ns),
        parent_frame_id=FRAME,
        child_frame_id=ROBOT_FRAME,
        translation=Vector3(x=pose.x_m, y=pose.y_m, z=z),
        rotation=_turned(pose.yaw_rad),
    )


def _turned(yaw: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def _grid(source: OccupancyMap, z: float, time_ns: int) -> Grid:
    x, y, yaw = source.origin
    return Grid(
        timestamp=timestamp(time_ns),
        frame_id=FRAME,
        pose=Pose(position=Vector3(x=x, y=y, z=z), orientation=_turned(yaw)),
        column_count=source.width,
        cell_size=Vector2(x=source.resolution, y=source.resolution),
        row_stride=source.width,
        cell_stride=1,
        fields=[
            PackedElementField(name="occupancy", offset=0, type=PackedElementFieldNumericType.Uint8)
        ],
        data=source.cells.tobytes(),
    )
