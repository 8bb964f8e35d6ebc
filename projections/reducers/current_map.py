"""The occupancy map in force: the last one given, from its offset on.

A second map replaces the first. What was folded before a map keeps its place: a fold never looks
back. Two poses are judged by the map in force when the later of them is folded.
"""

import numpy as np

from eventsrc.envelope import Offset
from eventsrc.occupancy_map import OccupancyMap
from projections.deltas import MapGiven
from projections.occupancy import OccupancyGrid
from projections.reducers import State
from projections.settings import Settings


class CurrentMap:
    """The reducer. ``grid`` has the walls of ``given``; both are None before the first map.

    Walls are worked out only for places by rooms, which use them: for a large map that takes
    seconds.
    """

    def __init__(self, settings: Settings) -> None:
        self._uses_walls = settings.places == "rooms"
        self.given: MapGiven | None = None
        self.grid: OccupancyGrid | None = None

    def fold(self, offset: Offset, given: OccupancyMap) -> MapGiven:
        """Take over a map."""
        delta = MapGiven(offset, given)
        self._use(delta)
        return delta

    def dump(self) -> State:
        """Everything, for a snapshot; nothing without a map."""
        if self.given is None:
            return {}
        given = self.given.map
        return {
            "offset": self.given.offset,
            "map_id": given.map_id,
            "resolution": given.resolution,
            "origin": list(given.origin),
            "source": given.source,
            "cells": given.cells,
        }

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        if state:
            x, y, yaw = state["origin"]
            cells = np.ascontiguousarray(state["cells"])
            fields = state["map_id"], state["resolution"], (x, y, yaw), state["source"]
            self._use(MapGiven(state["offset"], OccupancyMap(*fields, cells)))

    def _use(self, given: MapGiven) -> None:
        before = self.given
        self.given = given
        if self._uses_walls and (before is None or before.map.digest() != given.map.digest()):
            self.grid = OccupancyGrid(given.map)
