"""Floors: the floor of a pose, positions laid out so that reducers of x and y keep floors apart,
and the occupancy map in force on each floor.

An envelope names its floor (``floor``), or its height ``map_z`` gives it: floor n is nearest to
n × ``floor_height_m``, a height half-way belongs to the upper one. So 2.8 m is floor "1" at 3 m a
floor, and the same floor as that of an envelope with ``"floor": 1``. Poses without either are on a
floor of their own, which has no name.

The reducers of places and Objects are given *laid out* positions: those of each floor are moved
by a multiple of `STEP_UM`, which is ten times what a map spans. So nothing on two floors is ever
within reach of each other, whatever the rule, and the deltas are moved back. The floor that the
first pose of a log is on is not moved: a map of one floor is as it would be without floors.

Robots may have map frames of their own. The *map's* frame is that of the first pose, and of all
envelopes that name none; poses in another one that no command joins to it are held apart, as on
floors of their own.

A command that makes things on two floors one is obeyed for those on the floor whose detection, or
keyframe, came first.

A second map of a floor replaces the first; one with the same grid changes nothing. Keyframes folded
before a map keep their places: a fold never revises them. For two poses the map in force when the
later one is folded counts.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Any, TypeVar

import msgspec
import numpy as np

from eventsrc.envelope.model import Envelope, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap

from . import State, part, prefixed
from .corrections import FrameJoin
from .deltas import (
    Delta,
    EventSkipped,
    FrameJoined,
    MapGiven,
    ObjectEstimated,
    ObjectRelocated,
    ObjectSeen,
    ObjectsMerged,
    PlaceChanged,
    Pose,
)
from .driven_cells import StraightWay
from .exact import metres_to_um
from .free_floor import FreeFloor, free_floor
from .occupancy import Point
from .pair_groups import PairGroups
from .scans import Scans
from .settings import Settings
from .sights import Sighting

STEP_UM = 10**14
"""Between floors laid out; poses are within ±10¹³ µm."""
_FLOORS_A_ROW = 1024
_THING = TypeVar("_THING", bound=tuple[object, ...] | str)


def floor_name(envelope: Envelope, height_um: int) -> str | None:
    """The floor of an envelope with a pose; None if the envelope has neither name nor height."""
    if envelope.floor is not None:
        return envelope.floor
    if envelope.map_z is None:
        return None
    return str((2 * metres_to_um(envelope.map_z) + height_um) // (2 * height_um))


def shift_um(ordinal: int) -> tuple[int, int]:
    """The shift of the floor of this number, in x and y."""
    return ordinal % _FLOORS_A_ROW * STEP_UM, ordinal // _FLOORS_A_ROW * STEP_UM


def shift_of_sum(sum_x_um: int, sum_y_um: int, count: int) -> tuple[int, int]:
    """The shift of the floor that ``count`` things are on, from the sums of their positions."""
    step = STEP_UM * max(count, 1)
    return (
        (2 * sum_x_um + step) // (2 * step) * STEP_UM,
        (2 * sum_y_um + step) // (2 * step) * STEP_UM,
    )


class Floors:
    """The reducer. ``ordinals`` numbers the floors by their first pose, each a frame that is held
    apart, None for the map's, and the name of a floor in it, None for none; ``names`` are in that
    order. ``frame`` is the map's own."""

    def __init__(self, floor_height_m: float) -> None:
        self._height_um = metres_to_um(floor_height_m)
        self.ordinals: dict[tuple[str | None, str | None], int] = {}
        self.names: list[str | None] = []
        self.frame: str | None = None
        self._has_frame = False
        self._joined: set[str] = set()
        # The floor of each group of things joined by command, by kind and number of the group.
        self._homes: dict[tuple[str, int], int] = {}

    def enter(self, envelope: Envelope) -> tuple[str | None, int]:
        """The floor of an envelope with a pose, and its number."""
        if not self._has_frame:
            self.frame, self._has_frame = envelope.frame, True
        apart = None if envelope.frame == self.frame else envelope.frame
        floor = apart, floor_name(envelope, self._height_um)
        if floor not in self.ordinals:
            self.ordinals[floor] = len(self.names)
            self.names.append(_shown(*floor))
        number = self.ordinals[floor]
        return self.names[number], number

    def join(self, offset: Offset, joins: Iterable[FrameJoin]) -> Iterator[Delta]:
        """The deltas of the joins that no event before met."""
        for frame, into, by, command in joins:
            if frame not in self._joined:
                self._joined.add(frame)
                yield FrameJoined(offset, frame, into, by.dx, by.dy, by.dyaw, command)

    def number_at(self, x_um: int, y_um: int) -> int:
        """The number of the floor of a laid out position."""
        column, row = (x_um + STEP_UM // 2) // STEP_UM, (y_um + STEP_UM // 2) // STEP_UM
        return row * _FLOORS_A_ROW + column

    def keep_to_floor(self, groups: PairGroups[Any], thing: Any, kind: str, floor: int) -> None:
        """Remove ``thing``, which is on this floor, from its group if that is on another one."""
        group = groups.group_of.get(thing)
        if group is not None and self._homes.setdefault((kind, group), floor) != floor:
            del groups.group_of[thing]

    def laid_out(self, pose: Pose, ordinal: int) -> Pose:
        """The pose laid out, as reducers get it."""
        dx, dy = shift_um(ordinal)
        return Pose(pose.x_um + dx, pose.y_um + dy, pose.yaw_rad) if ordinal else pose

    def sightings(self, sightings: list[Sighting], ordinal: int) -> list[Sighting]:
        """The sightings with their stated positions laid out."""
        if not ordinal:
            return sightings
        dx, dy = (each / 1e6 for each in shift_um(ordinal))
        return [
            seen
            if seen.position is None
            else seen._replace(
                position=(seen.position[0] + dx, seen.position[1] + dy, seen.position[2])
            )
            for seen in sightings
        ]

    def put_back(self, deltas: list[Delta]) -> list[Delta]:
        """The deltas with positions as they are on their floor."""
        return [_put_back(delta) for delta in deltas] if len(self.ordinals) > 1 else deltas

    def dump(self) -> State:
        """The whole state, to be kept."""
        homes = [[kind, group, floor] for (kind, group), floor in sorted(self._homes.items())]
        floors, joined = [list(each) for each in self.ordinals], sorted(self._joined)
        frame = [self.frame] if self._has_frame else []
        return {"floors": floors, "homes": homes, "frame": frame, "joined": joined}

    def load(self, state: State) -> None:
        """Restore the state of `dump`; an empty one is of a map of one floor."""
        floors = [(apart, name) for apart, name in state.get("floors", [(None, None)])]
        self.ordinals = {floor: ordinal for ordinal, floor in enumerate(floors)}
        self.names = [_shown(*floor) for floor in floors]
        for self.frame in state.get("frame", ()):
            self._has_frame = True
        self._joined = set(state.get("joined", ()))
        self._homes = {(kind, group): floor for kind, group, floor in state.get("homes", ())}


def _shown(apart: str | None, name: str | None) -> str | None:
    """What a floor is called; one of a frame that is held apart has that in its name."""
    if apart is None:
        return name
    return f"frame {apart}" if name is None else f"{name} in frame {apart}"


def _put_back(delta: Delta) -> Delta:
    replace = msgspec.structs.replace
    if isinstance(delta, PlaceChanged):
        count = delta.keyframe_count
        dx, dy = shift_of_sum(delta.sum_x_um, delta.sum_y_um, count)
        if dx or dy:
            x, y = delta.sum_x_um - count * dx, delta.sum_y_um - count * dy
            return replace(delta, sum_x_um=x, sum_y_um=y)
    elif isinstance(delta, ObjectSeen | ObjectsMerged):
        count = delta.obs_count
        dx, dy = shift_of_sum(delta.sum_x_um, delta.sum_y_um, count)
        if dx or dy:
            x, y = delta.sum_x_um - count * dx, delta.sum_y_um - count * dy
            return replace(delta, sum_x_um=x, sum_y_um=y)
    elif isinstance(delta, ObjectEstimated):
        dx, dy = shift_of_sum(delta.x_um, delta.y_um, 1)
        if dx or dy:
            return replace(delta, x_um=delta.x_um - dx, y_um=delta.y_um - dy)
    elif isinstance(delta, ObjectRelocated):
        dx, dy = shift_of_sum(delta.to_x_um, delta.to_y_um, 1)
        if dx or dy:
            return replace(
                delta,
                from_x_um=delta.from_x_um - dx,
                from_y_um=delta.from_y_um - dy,
                to_x_um=delta.to_x_um - dx,
                to_y_um=delta.to_y_um - dy,
            )
    return delta


def map_in_force(
    given: Mapping[str | None, MapGiven], floor: str | None, *, is_first: bool
) -> MapGiven | None:
    """The map on ``floor``, of those ``given`` by the floor that they name. One without a floor
    name is of the log's first floor, unless another names that floor."""
    named = None if floor is None else given.get(floor)
    return given.get(None) if named is None and is_first else named


class CurrentMap:
    """The reducer. ``given`` are the maps by the floor that they name.

    Walls are computed when the first pose on their floor is folded after the map, because that
    takes time for a large map: maps replaced before that cost nothing.
    """

    def __init__(self, settings: Settings, floors: Floors) -> None:
        self._uses_walls = settings.places == "rooms"
        self._floors = floors
        self.given: dict[str | None, MapGiven] = {}
        self._scans = Scans()
        # By number of the floor; only those already computed.
        self._grounds: dict[int, FreeFloor | None] = {}
        self._ways: dict[int, StraightWay | None] = {}

    def fold(self, offset: Offset, given: OccupancyMap) -> MapGiven | None:
        """Put a map into force and return its delta; None if it changes nothing."""
        before = self.given.get(given.floor)
        if before is not None and before.map.digest() == given.digest():
            return None
        delta = self.given[given.floor] = MapGiven(offset, given)
        self._grounds.clear()
        self._ways.clear()
        return delta

    def scan(
        self, offset: Offset, number: int, pose: Pose, envelope: Envelope
    ) -> MapGiven | EventSkipped | None:
        """Cast the scan of an envelope on the floor of this number; returns the delta of a map that
        is made of it and those before. It is left out where a map is given, or too far away."""
        name, scan = self._floors.names[number], envelope.scan
        if scan is None or (number and name is None):
            return None
        in_force = map_in_force(self.given, name, is_first=not number)
        if in_force is not None and not in_force.scanned:
            self._scans.forget(number)
            return None
        made = self._scans.add(number, name if number else None, pose, scan)
        if made is False:
            return EventSkipped(offset, "scan_too_far", envelope.run_id, envelope.keyframe_id)
        if made is True:
            return None
        delta = self.given[made.floor] = MapGiven(offset, made, scanned=True)
        self._grounds.pop(number, None)
        self._ways.pop(number, None)
        return delta

    @property
    def has_walls(self) -> bool:
        """Whether the places use the walls of any map."""
        return self._uses_walls and bool(self.given)

    def way_at(self, at: Point) -> StraightWay | None:
        """The function that measures straight ways on the floor of a laid-out position
        (`projections.fold.floors`); None where the floor has no map."""
        number = self._floors.number_at(*at)
        if number not in self._ways:
            self._ways[number] = self._way_on(number)
        return self._ways[number]

    def floor_at(self, at: Point) -> tuple[int, FreeFloor, Point] | None:
        """The number of the floor of a laid-out position, its free floor, and where on it that is;
        None where the floor has no map."""
        number = self._floors.number_at(*at)
        ground = self._ground(number)
        if ground is None:
            return None
        dx, dy = shift_um(number)
        return number, ground, (at[0] - dx, at[1] - dy)

    def _way_on(self, number: int) -> StraightWay | None:
        ground = self._ground(number)
        if ground is None:
            return None
        way = ground.grid.straight_way_um
        return partial(_moved_back, way, *shift_um(number)) if number else way

    def _ground(self, number: int) -> FreeFloor | None:
        if number not in self._grounds:
            given = map_in_force(self.given, self._floors.names[number], is_first=number == 0)
            self._grounds[number] = None if given is None else free_floor(given.map)
        return self._grounds[number]

    def dump(self) -> State:
        """The whole state, to be kept; nothing without a map."""
        parts: State = {}
        for number, (offset, given, scanned) in enumerate(
            (delta.offset, delta.map, delta.scanned) for delta in self.given.values()
        ):
            fields = {
                "offset": offset,
                "floor": given.floor,
                "map_id": given.map_id,
                "resolution": given.resolution,
                "origin": list(given.origin),
                "source": given.source,
                "cells": given.cells,
                "scanned": scanned,
            }
            parts |= prefixed(str(number), fields)
        scans = prefixed("scans", self._scans.dump())
        return ({"maps": len(self.given), **parts} if parts else {}) | scans

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for number in range(state.get("maps", 0)):
            fields = part(str(number), state)
            x, y, yaw = fields["origin"]
            about = fields["map_id"], fields["resolution"], (x, y, yaw), fields["source"]
            cells = np.ascontiguousarray(fields["cells"])
            loaded = OccupancyMap(*about, cells, fields["floor"])
            self.given[loaded.floor] = MapGiven(fields["offset"], loaded, fields["scanned"])
        self._scans.load(part("scans", state))


def _moved_back(way: StraightWay, dx: int, dy: int, a: Point, b: Point) -> int | None:
    return way((a[0] - dx, a[1] - dy), (b[0] - dx, b[1] - dy))
