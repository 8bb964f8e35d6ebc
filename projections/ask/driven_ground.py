"""Ground that robots drove on, and ways over it.

Poses are thinned to one, the first, for each square of `_CELL_M`. Two are linked when a run went
from one straight to the other, at most `STEP_M`, or when they are within `_BESIDE_M` of each
other with no wall in between. So a way goes where robots went, and a robot can drive it.
"""

import heapq
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from projections.fold.exact import UM_PER_M, metres_to_um
from projections.fold.free_floor import free_floor
from projections.fold.occupancy import OccupancyGrid
from projections.map.records import KeyframeRecord, ObjectRecord, Poses
from projections.map.view import MapView

_MOST_OFF_M: Final = 10.0
Spot = tuple[float, float]
"""Metres in the map frame."""

_CELL_M: Final = 0.25
_BESIDE_M: Final = 0.75
_REACH: Final = math.ceil(_BESIDE_M / _CELL_M)
_ROUNDING: Final = 1e-9
"""By so much numpy's distances may differ from `math.dist`, which decides."""
STEP_M: Final = 5.0
Floor = str | None


class DrivenGround:
    """The driven ground of a map, without the map. A *node* is the first pose in a square, and
    ``spots`` are their positions. ``grids`` are the occupancy maps by floor."""

    def __init__(self, view: MapView) -> None:
        self.grids: dict[Floor, OccupancyGrid] = {
            floor: free_floor(given.map).grid for floor, given in view.maps_in_force().items()
        }
        poses = view.poses()
        squares, wide = _squares(poses)
        found, first, of = np.unique(squares, return_index=True, return_inverse=True)
        numbers = np.empty(len(first), np.int64)  # by square its node, in the order of their poses
        numbers[np.argsort(first)] = np.arange(len(first))
        nodes, first = numbers[of], np.sort(first)
        self._keyframes = view.keyframes
        self._ordinals: list[int] = poses.keyframes[first].tolist()
        self._nodes = np.full(len(view.keyframes), -1)
        self._nodes[poses.keyframes] = nodes
        self._metres = poses.positions_um[first] / UM_PER_M
        self.spots: list[Spot] = [(x, y) for x, y in self._metres.tolist()]
        went = np.flatnonzero((np.diff(poses.runs) == 0) & (np.diff(nodes) != 0))
        driven = self._within(np.stack([nodes[went], nodes[went + 1]]), STEP_M)
        beside = self._within(np.sort(numbers[_beside(found, wide)], axis=0), _BESIDE_M)
        a, b = np.concatenate([driven, self._without_walls(beside)], axis=1)
        count = len(first)
        links = np.sort(np.concatenate([a * count + b, b * count + a]))
        links = links[np.diff(links, prepend=-1) > 0]  # numpy's unique takes ten times as long
        self._links: list[int] = (links % max(count, 1)).tolist()
        """The nodes that each is linked with, end to end; those of a node from ``_starts`` on."""
        self._starts: list[int] = np.searchsorted(links, np.arange(count + 1) * count).tolist()

    def nearest(self, spot: Spot, among: Iterable[int] | None = None) -> int:
        """The node that is nearest to a spot in a straight line. Raises MisuseError for none, and
        without ``among`` for a spot more than `_MOST_OFF_M` away from all."""
        is_limited = among is None
        if among is None:
            with np.errstate(over="ignore"):
                away = np.hypot(*(self._metres - spot).T)
                # of those that rounding may have put in another order the nearest is sought again
                among = np.flatnonzero(
                    away <= away.min(initial=math.inf) * (1 + _ROUNDING)
                ).tolist()
        found = min(among, key=lambda n: (math.dist(self.spots[n], spot), n), default=None)
        if found is None:
            raise MisuseError("this map has no driven ground: no keyframe has a pose")
        away_m = math.dist(self.spots[found], spot)
        if is_limited and away_m > _MOST_OFF_M:
            raise MisuseError(
                f"{spot[0]:g},{spot[1]:g} is {away_m:.3g} m from where robots have driven; give a"
                f" point within {_MOST_OFF_M:g} m"
            )
        return found

    def keyframe(self, node: int) -> KeyframeRecord:
        """The keyframe that a node is the pose of."""
        return self._keyframes[self._ordinals[node]]

    def nodes_of(self, keyframes: Sequence[int]) -> list[int]:
        """The nodes of those of some keyframes that have a pose."""
        found = self._nodes[keyframes] if keyframes else self._nodes[:0]
        nodes: list[int] = found[found >= 0].tolist()
        return nodes

    def lengths_from(self, start: int) -> tuple[dict[int, float], dict[int, int]]:
        """The length of the shortest way to each node that has one, and the node before it."""
        lengths, before = {start: 0.0}, dict[int, int]()
        waiting, done = [(0.0, start)], set[int]()
        while waiting:
            length, node = heapq.heappop(waiting)
            if node in done:
                continue
            done.add(node)
            spot = self.spots[node]
            for other in self._links[self._starts[node] : self._starts[node + 1]]:
                longer = length + math.dist(spot, self.spots[other])
                if longer < lengths.get(other, math.inf):
                    lengths[other], before[other] = longer, node
                    heapq.heappush(waiting, (longer, other))
        return lengths, before

    def nodes_between(self, start: int, end: int) -> list[int] | None:
        """The nodes of the shortest way, both ends included; None where there is none."""
        lengths, before = self.lengths_from(start)
        if end not in lengths:
            return None
        nodes = [end]
        while nodes[-1] != start:
            nodes.append(before[nodes[-1]])
        return nodes[::-1]

    def way_m(
        self, found: ObjectRecord, seen_by: Sequence[int], lengths: Mapping[int, float]
    ) -> float | None:
        """The length of the shortest way to an Object: driven to where some keyframes saw it from,
        then straight; None where none of that is reached."""
        ways = [
            lengths[node] + math.dist(self.spots[node], found.spot)
            for node in self.nodes_of(seen_by)
            if node in lengths
        ]
        return min(ways, default=None)

    def is_free(self, floor: Floor, a: Spot, b: Spot) -> bool:
        """Whether no wall is known on the straight line between two spots of a floor."""
        grid = self.grids.get(floor)
        return grid is None or grid.is_free_line(um_of(a), um_of(b))

    def _within(self, pairs: NDArray[np.int64], most_m: float) -> NDArray[np.int64]:
        """The pairs of nodes, shape (2, n), that are at most so far from each other."""
        away = np.hypot(*(self._metres[pairs[0]] - self._metres[pairs[1]]).T)
        is_near = away <= most_m
        for row in np.flatnonzero(np.abs(away - most_m) <= most_m * _ROUNDING).tolist():
            a, b = pairs[:, row].tolist()
            is_near[row] = math.dist(self.spots[a], self.spots[b]) <= most_m
        return pairs[:, is_near]

    def _without_walls(self, pairs: NDArray[np.int64]) -> NDArray[np.int64]:
        """The pairs of nodes of a floor with no known wall in between."""
        if not self.grids:
            return pairs
        is_free = [
            self.is_free(self.keyframe(a).floor, self.spots[a], self.spots[b])
            for a, b in pairs.T.tolist()
        ]
        return pairs[:, is_free]


def _squares(poses: Poses) -> tuple[NDArray[np.int64], int]:
    """The square of each pose as a number, and by how much that grows from one column to the next.
    Between the squares of two floors there are `_REACH` empty ones, so none of them is beside one
    of another floor."""
    cells = poses.positions_um // metres_to_um(_CELL_M)
    columns, rows = (cells - cells.min(axis=0, initial=0)).T
    wide = int(rows.max(initial=0)) + 1 + _REACH
    floor = (int(columns.max(initial=0)) + 1 + _REACH) * wide
    return poses.floors * floor + columns * wide + rows, wide


def _beside(squares: NDArray[np.int64], wide: int) -> NDArray[np.int64]:
    """The pairs of ascending squares, as indices of shape (2, n), that are at most `_REACH` columns
    and rows apart."""
    steps = [
        columns * wide + rows
        for columns in range(_REACH + 1)
        for rows in range(-_REACH, _REACH + 1)
        if (columns, rows) > (0, 0)
    ]
    pairs = []
    for step in steps:
        at = np.minimum(np.searchsorted(squares, squares + step), len(squares) - 1)
        there = np.flatnonzero(squares[at] == squares + step)
        pairs.append(np.stack([there, at[there]]))
    return np.concatenate(pairs, axis=1)


def um_of(spot: Spot) -> tuple[int, int]:
    """A position in µm."""
    return metres_to_um(spot[0]), metres_to_um(spot[1])
