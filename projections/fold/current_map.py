"""The occupancy maps in force: of each floor the last one given, from its offset on.

A second map of a floor replaces the first; one with the same grid changes nothing. Keyframes folded
before a map keep their places: a fold never revises them. For two poses the map in force when the
later one is folded counts.

A map without a floor name is of the log's first floor, unless another map names that floor.
"""

from collections.abc import Mapping
from functools import partial

import numpy as np

from eventsrc.envelope.model import Offset
from eventsrc.envelope.occupancy_map import OccupancyMap

from . import State, part, prefixed
from .deltas import MapGiven
from .driven_cells import StraightWay
from .floors import Floors, shift_um
from .occupancy import OccupancyGrid, Point
from .settings import Settings


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
    takes a second or two for a large map: maps replaced before that cost nothing.
    """

    def __init__(self, settings: Settings, floors: Floors) -> None:
        self._uses_walls = settings.places == "rooms"
        self._floors = floors
        self.given: dict[str | None, MapGiven] = {}
        # By number of the floor; only those already computed.
        self._ways: dict[int, StraightWay | None] = {}

    def fold(self, offset: Offset, given: OccupancyMap) -> MapGiven | None:
        """Put a map into force and return its delta; None if it changes nothing."""
        before = self.given.get(given.floor)
        if before is not None and before.map.digest() == given.digest():
            return None
        delta = self.given[given.floor] = MapGiven(offset, given)
        self._ways.clear()
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

    def _way_on(self, number: int) -> StraightWay | None:
        given = map_in_force(self.given, self._floors.names[number], is_first=number == 0)
        if given is None:
            return None
        way = OccupancyGrid(given.map).straight_way_um
        return partial(_moved_back, way, *shift_um(number)) if number else way

    def dump(self) -> State:
        """The whole state, for a snapshot; nothing without a map."""
        parts: State = {}
        for number, (offset, given) in enumerate(
            (delta.offset, delta.map) for delta in self.given.values()
        ):
            fields = {
                "offset": offset,
                "floor": given.floor,
                "map_id": given.map_id,
                "resolution": given.resolution,
                "origin": list(given.origin),
                "source": given.source,
                "cells": given.cells,
            }
            parts |= prefixed(str(number), fields)
        return {"maps": len(self.given), **parts} if parts else {}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for number in range(state.get("maps", 0)):
            fields = part(str(number), state)
            x, y, yaw = fields["origin"]
            about = fields["map_id"], fields["resolution"], (x, y, yaw), fields["source"]
            cells = np.ascontiguousarray(fields["cells"])
            self.fold(fields["offset"], OccupancyMap(*about, cells, fields["floor"]))


def _moved_back(way: StraightWay, dx: int, dy: int, a: Point, b: Point) -> int | None:
    return way((a[0] - dx, a[1] - dy), (b[0] - dx, b[1] - dy))
