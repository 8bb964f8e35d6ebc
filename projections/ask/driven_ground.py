"""Ground that robots drove on, ways over it, and poses on it from which a thing can be seen.

Poses are thinned to one, the first, for each square of `_CELL_M`. Two are linked when a run went
from one straight to the other, at most `STEP_M`, or when they are within `_BESIDE_M` of each
other with no wall in between. So a way goes where robots went, and a robot can drive it.

The *goal* of an Object is a pose that faces it, `clearance_m` or more from all walls where those
are known. A pose from which the Object was seen where it stands now comes first, then another
driven one, then free floor of an occupancy map, both with a free line of sight.

Of the poses that saw it the best one has most others that saw it around it, for one detection may
be of a thing beside it, and is some `_BEST_M` away. It counts against a pose how few those are (up
to 1, `_flaws`), each metre that it is nearer or farther (`_A_METRE`) or, up to one, off the ground
of the last run (`_OFF_LAST`), that a later run saw the Object too (`_EARLIER`), that another Object
stands there and that a wall is in the line of sight, for estimates err (`_BLOCKED` each). Of the
others the best one is as far away as the Object is seen from usually. Of equal ones the earliest.
"""

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.envelope.occupancy_map import MIN_WALL, OCCUPIED
from projections.fold.exact import UM_PER_M, metres_to_um
from projections.fold.free_floor import free_floor
from projections.fold.occupancy import OccupancyGrid
from projections.map.records import KeyframeRecord, ObjectRecord, Poses
from projections.map.view import MapView

from .goal_pose import GoalPose

CLEARANCE_M: Final = 0.3
_MOST_OFF_M: Final = 10.0
Floats = NDArray[np.float64]
Spot = tuple[float, float]
"""Metres in the map frame."""

_CELL_M: Final = 0.25
_BESIDE_M: Final = 0.75
_REACH: Final = math.ceil(_BESIDE_M / _CELL_M)
_ROUNDING: Final = 1e-9
"""By so much numpy's distances may differ from `math.dist`, which decides."""
STEP_M: Final = 5.0
_BEST_M: Final = 2.5
_A_METRE: Final = 0.2
_EARLIER: Final = 0.3
_OFF_LAST: Final = 0.5
_BLOCKED: Final = 1.0
_AROUND_M: Final = 0.7
_MANY: Final = 2.0
_STANDS_M: Final = 0.4
"""So near to its estimate an Object stands in the way of a robot."""
_LEAST_M, _MOST_M = 0.5, 4.0
_RINGS: Final = (1.2, 1.0, 1.4, 0.8, 1.6, 2.0, 0.6, 2.5)
_TURNS: Final = 16
_Floor = str | None
_Candidate = tuple[Spot, _Floor, KeyframeRecord | None, float]
"""A spot on a floor, the keyframe that was there, and by how much it is worse than the best."""


class DrivenGround:
    """The driven ground of a map, without the map. A *node* is the first pose in a square, and
    ``spots`` are their positions."""

    def __init__(self, view: MapView) -> None:
        self._grids: dict[_Floor, OccupancyGrid] = {
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
        floors: set[_Floor] = {poses.names[number] for number in np.unique(poses.floors).tolist()}
        self._standing: dict[tuple[_Floor, int, int], list[ObjectRecord]] = {}
        for each in view.objects.values():
            if each.confirmed and each.estimate is not None and each.missing_in is None:
                of_it = floors
                if len(floors) > 1:  # without floors the sightings need not be read
                    of_it = {keyframe.floor for keyframe in view.sightings(each)}
                for floor in of_it:
                    self._standing.setdefault((floor, *_stand(each.spot)), []).append(each)
        self._floors = {floor: number for number, floor in enumerate(poses.names)}
        at_last = np.flatnonzero(poses.runs == poses.runs.max(initial=0))
        self._last: Floats = np.column_stack(
            [poses.positions_um[at_last] / UM_PER_M, poses.floors[at_last]]
        )
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

    def goal(
        self,
        found: ObjectRecord,
        seen_by: Iterable[KeyframeRecord],
        clearance_m: float = CLEARANCE_M,
    ) -> GoalPose:
        """The goal of an Object, which some keyframes saw. Raises MisuseError for none."""
        since = found.relocations[-1].offset if found.relocations else 0
        seen = [k for k in seen_by if k.pose is not None and k.offset >= since]
        distances = sorted(math.dist(_spot(keyframe), found.spot) for keyframe in seen)
        usual = distances[len(distances) // 2] if distances else _RINGS[0]
        for ground, candidates in (
            ("seen", self._seen(found, seen)),
            ("driven", self._driven()),
            ("free", self._around(found)),
        ):
            best: tuple[float, int] | None = None
            goal: GoalPose | None = None
            for number, (spot, floor, keyframe, worse) in enumerate(candidates):
                distance = math.dist(spot, found.spot)
                is_seen = ground == "seen"
                off = abs(distance - (_BEST_M if is_seen else usual))
                rank = round(worse + off * _A_METRE, 3), number
                if distance < _LEAST_M or (best is not None and rank >= best):
                    continue
                if not self._is_clear(floor, spot, clearance_m):
                    continue
                if not is_seen and (
                    distance > _MOST_M or not self.is_free(floor, spot, found.spot)
                ):
                    continue
                best = rank
                goal = GoalPose(
                    *(spot[0], spot[1], _bearing(spot, found.spot), distance, ground),
                    *(floor in self._grids, floor),
                    None if keyframe is None else keyframe.run_id,
                    None if keyframe is None else keyframe.keyframe_id,
                )
            if goal is not None:
                return goal
        raise MisuseError(
            f"no pose from which {visible(found.class_name)} {found.object_id} can be seen is"
            f" {clearance_m:g} m from walls; give a smaller --clearance"
        )

    def _seen(self, found: ObjectRecord, seen: Sequence[KeyframeRecord]) -> Iterator[_Candidate]:
        """Poses that saw an Object where it stands now."""
        last = max((keyframe.run for keyframe in seen), default=None)
        flaws = self._flaws(seen)
        for keyframe in sorted(seen, key=lambda k: k.ordinal):
            spot = _spot(keyframe)
            blocked = int(self._is_taken(keyframe.floor, spot, found))
            blocked += not self.is_free(keyframe.floor, spot, found.spot)
            worse = flaws[int(self._nodes[keyframe.ordinal])] + _BLOCKED * blocked
            yield spot, keyframe.floor, keyframe, worse + _EARLIER * (keyframe.run != last)

    def _flaws(self, seen: Sequence[KeyframeRecord]) -> dict[int, float]:
        """By node of poses that saw an Object: how few of them are around it, and how far the last
        run was."""
        saw = self._places(seen)
        flaws = dict[int, float]()
        for node in set(self.nodes_of([keyframe.ordinal for keyframe in seen])):
            place = *self.spots[node], self._floors[self.keyframe(node).floor]
            around = np.exp(_apart(saw, place) ** 2 / (-2 * _AROUND_M**2)).sum()
            off = _apart(self._last, place).min(initial=1.0)
            flaws[node] = math.exp(-float(around) / _MANY) + _OFF_LAST * float(off)
        return flaws

    def _places(self, keyframes: Iterable[KeyframeRecord]) -> Floats:
        """x, y and the number of the floor of each keyframe."""
        return np.array([(*_spot(each), self._floors[each.floor]) for each in keyframes])

    def _is_taken(self, floor: _Floor, spot: Spot, found: ObjectRecord) -> bool:
        """Whether another Object than ``found`` stands at a spot of a floor."""
        column, row = _stand(spot)
        return any(
            other is not found and math.dist(other.spot, spot) < _STANDS_M
            for x in (column - 1, column, column + 1)
            for y in (row - 1, row, row + 1)
            for other in self._standing.get((floor, x, y), ())
        )

    def is_free(self, floor: _Floor, a: Spot, b: Spot) -> bool:
        """Whether no wall is known on the straight line between two spots of a floor."""
        grid = self._grids.get(floor)
        return grid is None or grid.is_free_line(_um(a), _um(b))

    def _driven(self) -> Iterator[_Candidate]:
        for node, spot in enumerate(self.spots):
            keyframe = self.keyframe(node)
            yield spot, keyframe.floor, keyframe, 0.0

    def _around(self, found: ObjectRecord) -> Iterator[_Candidate]:
        """Free floor around an Object."""
        for floor, grid in self._grids.items():
            for radius in _RINGS:
                for turn in range(_TURNS):
                    angle = 2 * math.pi * turn / _TURNS
                    x, y = found.spot
                    spot = x + radius * math.cos(angle), y + radius * math.sin(angle)
                    column, row = grid.cell(_um(spot))
                    rows, columns = grid.walls.shape
                    inside = 0 <= row < rows and 0 <= column < columns
                    if inside and grid.source.cells[row, column] < MIN_WALL:
                        yield spot, floor, None, 0.0

    def _is_clear(self, floor: _Floor, spot: Spot, clearance_m: float) -> bool:
        """Whether all known walls are so far from a spot."""
        grid = self._grids.get(floor)
        if grid is None:
            return True
        reach = math.ceil(clearance_m / grid.source.resolution) + 1
        column, row = grid.cell(_um(spot))
        top, left = max(row - reach, 0), max(column - reach, 0)
        window = grid.source.cells[top : row + reach + 1, left : column + reach + 1]
        if window.size == 0:
            return True
        rows, columns = np.nonzero((window >= MIN_WALL) & (window <= OCCUPIED))
        across = np.maximum(np.abs(columns + left - column) - 0.5, 0.0)
        down = np.maximum(np.abs(rows + top - row) - 0.5, 0.0)
        near = (across**2 + down**2) * grid.source.resolution**2
        return not bool((near < clearance_m**2).any())

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
        if not self._grids:
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


def _spot(keyframe: KeyframeRecord) -> Spot:
    x_um, y_um = _pose_um(keyframe)
    return x_um / UM_PER_M, y_um / UM_PER_M


def _pose_um(keyframe: KeyframeRecord) -> tuple[int, int]:
    pose = keyframe.pose
    assert pose is not None  # noqa: S101 - others are no ground
    return pose.x_um, pose.y_um


def _um(spot: Spot) -> tuple[int, int]:
    return metres_to_um(spot[0]), metres_to_um(spot[1])


def _stand(spot: Spot) -> tuple[int, int]:
    """The square of a spot, `_STANDS_M` wide."""
    return math.floor(spot[0] / _STANDS_M), math.floor(spot[1] / _STANDS_M)


def _apart(places: Floats, place: tuple[float, float, int]) -> Floats:
    """The distances of places from one, infinite from one on another floor."""
    x, y, floor = place
    apart: Floats = np.hypot(places[:, 0] - x, places[:, 1] - y)
    return np.where(places[:, 2] == floor, apart, math.inf)


def _bearing(spot: Spot, to: Spot) -> float:
    """Radians."""
    return math.atan2(to[1] - spot[1], to[0] - spot[0])
