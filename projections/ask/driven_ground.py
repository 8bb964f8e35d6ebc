"""Ground that robots drove on, ways over it, and poses on it from which a thing can be seen.

Poses are thinned to one, the first, for each square of `_CELL_M`. Two are linked when a run went
from one straight to the other, at most `STEP_M`, or when they are within `_BESIDE_M` of each
other with no wall in between. So a way goes where robots went, and a robot can drive it.

The *goal* of an Object is a pose that faces it, `clearance_m` or more from all walls where those
are known. A pose from which the Object was seen where it stands now comes first, then another
driven one, then free floor of an occupancy map, both with a free line of sight.

Of the poses that saw it the best one has most others that saw it around it, for one detection may
be of a thing beside it, and is some `_BEST_M` away. It counts against a pose how few those are (up
to 1, `_flaws`), each metre that it is nearer or farther (`_A_METRE`) or off the ground of the last
run (`_OFF_LAST`), that a later run saw the Object too (`_EARLIER`), that another Object stands
there and that a wall is in the line of sight, for estimates err (`_BLOCKED` each). Of the others
the best one is as far away as the Object is seen from usually. Of equal ones the earliest.
"""

import heapq
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.envelope.occupancy_map import MIN_WALL, OCCUPIED
from projections.fold.exact import UM_PER_M, metres_to_um
from projections.fold.free_floor import free_floor
from projections.fold.occupancy import OccupancyGrid
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.view import MapView

CLEARANCE_M: Final = 0.3
Floats = NDArray[np.float64]
Spot = tuple[float, float]
"""Metres in the map frame."""

_CELL_M: Final = 0.25
_BESIDE_M: Final = 0.75
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


@dataclass(frozen=True, slots=True)
class GoalPose:
    """A pose in metres and radians from which to see a thing, ``distance_m`` away. ``ground`` says
    what it stands on: ``seen`` that the thing was seen from there, by ``run_id`` and
    ``keyframe_id``. ``walls_known`` is false where no occupancy map says how far walls are."""

    x: float
    y: float
    yaw: float
    distance_m: float
    ground: str
    walls_known: bool
    floor: str | None
    run_id: str | None
    keyframe_id: int | None
    frame_id: str = "map"

    def __repr__(self) -> str:
        at = f"({self.x:.2f}, {self.y:.2f}) facing {math.degrees(self.yaw):.0f}°"
        return f"<goal at {at}, {self.distance_m:.2f} m away, {self.ground} ground>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    def pose_stamped(self) -> str:
        """As ``geometry_msgs/PoseStamped`` in YAML, its stamp zero, which means now."""
        position, orientation = self._in_yaml()
        return (
            "header:\n  stamp: {sec: 0, nanosec: 0}\n  frame_id: map\n"
            f"pose:\n  position: {position}\n  orientation: {orientation}\n"
        )

    def topic_pub(self) -> str:
        """As a command line of ROS 2 that sends it to Nav2."""
        position, orientation = self._in_yaml()
        pose = f"{{position: {position}, orientation: {orientation}}}"
        message = f"{{header: {{frame_id: map}}, pose: {pose}}}"
        return f"ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '{message}'\n"

    def _in_yaml(self) -> tuple[str, str]:
        z, w = math.sin(self.yaw / 2), math.cos(self.yaw / 2)
        return (
            f"{{x: {self.x:.3f}, y: {self.y:.3f}, z: 0.0}}",
            f"{{x: 0.0, y: 0.0, z: {z:.6f}, w: {w:.6f}}}",
        )


class DrivenGround:
    """The driven ground of a map, without the map. ``nodes`` are its keyframes, one a square."""

    def __init__(self, view: MapView) -> None:
        self._grids: dict[_Floor, OccupancyGrid] = {
            floor: free_floor(given.map).grid for floor, given in view.maps_in_force().items()
        }
        self.nodes: list[KeyframeRecord] = []
        self.spots: list[Spot] = []
        self._of: dict[tuple[_Floor, int, int], int] = {}
        self._links: list[dict[int, float]] = []
        self._standing: dict[tuple[_Floor, int, int], list[ObjectRecord]] = {}
        every_floor = {keyframe.floor for keyframe in view.keyframes}
        for each in view.objects.values():
            if each.confirmed and each.estimate is not None and each.missing_in is None:
                floors = every_floor
                if len(every_floor) > 1:  # without floors the sightings need not be read
                    floors = {keyframe.floor for keyframe in view.sightings(each)}
                for floor in floors:
                    self._standing.setdefault((floor, *_stand(each.spot)), []).append(each)
        last: dict[int, tuple[int, int]] = {}
        self._floors = {floor: number for number, floor in enumerate(every_floor)}
        self._posed = [k for k in view.keyframes if k.pose is not None]
        for keyframe in sorted(self._posed, key=lambda k: (k.run, k.keyframe_id)):
            node = self._node(keyframe)
            before = last.get(keyframe.run)
            if before is not None and before[0] != node:
                self._link(before[0], node, STEP_M)
            last[keyframe.run] = node, keyframe.ordinal
        for node in range(len(self.nodes)):
            for other in self._beside(node):
                if self.is_free(self.nodes[node].floor, self.spots[node], self.spots[other]):
                    self._link(node, other, _BESIDE_M)

    def nearest(self, spot: Spot, among: Iterable[int] | None = None) -> int:
        """The node that is nearest to a spot in a straight line. Raises MisuseError for none."""
        nodes = range(len(self.nodes)) if among is None else among
        found = min(nodes, key=lambda n: (math.dist(self.spots[n], spot), n), default=None)
        if found is None:
            raise MisuseError("this map has no driven ground: no keyframe has a pose")
        return found

    def node_of(self, keyframe: KeyframeRecord) -> int | None:
        """The node of a keyframe; None without a pose."""
        return None if keyframe.pose is None else self._of[self._square(keyframe)]

    def lengths_from(self, start: int) -> tuple[dict[int, float], dict[int, int]]:
        """The length of the shortest way to each node that has one, and the node before it."""
        lengths, before = {start: 0.0}, dict[int, int]()
        waiting, done = [(0.0, start)], set[int]()
        while waiting:
            length, node = heapq.heappop(waiting)
            if node in done:
                continue
            done.add(node)
            for other, step in self._links[node].items():
                if length + step < lengths.get(other, math.inf):
                    lengths[other], before[other] = length + step, node
                    heapq.heappush(waiting, (length + step, other))
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
        self, found: ObjectRecord, seen_by: Iterable[KeyframeRecord], lengths: Mapping[int, float]
    ) -> float | None:
        """The length of the shortest way to an Object: driven to where it was seen from, then
        straight; None where none of that is reached."""
        ways = [
            lengths[node] + math.dist(self.spots[node], found.spot)
            for keyframe in seen_by
            if (node := self.node_of(keyframe)) is not None and node in lengths
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
            worse = flaws[self._of[self._square(keyframe)]] + _BLOCKED * blocked
            yield spot, keyframe.floor, keyframe, worse + _EARLIER * (keyframe.run != last)

    def _flaws(self, seen: Sequence[KeyframeRecord]) -> dict[int, float]:
        """By node of poses that saw an Object: how few of them are around it, and how far the last
        run was."""
        saw = self._places(seen)
        flaws = dict[int, float]()
        for node in {self._of[self._square(keyframe)] for keyframe in seen}:
            place = *self.spots[node], self._floors[self.nodes[node].floor]
            around = np.exp(_apart(saw, place) ** 2 / (-2 * _AROUND_M**2)).sum()
            off = _apart(self._last, place).min(initial=1.0)
            flaws[node] = math.exp(-float(around) / _MANY) + _OFF_LAST * float(off)
        return flaws

    @cached_property
    def _last(self) -> Floats:
        """Where the last run was."""
        last = max(keyframe.run for keyframe in self._posed)
        return self._places([keyframe for keyframe in self._posed if keyframe.run == last])

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
        for spot, keyframe in zip(self.spots, self.nodes, strict=True):
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

    def _square(self, keyframe: KeyframeRecord) -> tuple[_Floor, int, int]:
        x_um, y_um = _pose_um(keyframe)
        side = metres_to_um(_CELL_M)
        return keyframe.floor, x_um // side, y_um // side

    def _node(self, keyframe: KeyframeRecord) -> int:
        square = self._square(keyframe)
        if square not in self._of:
            self._of[square] = len(self.nodes)
            self.nodes.append(keyframe)
            self.spots.append(_spot(keyframe))
            self._links.append({})
        return self._of[square]

    def _link(self, a: int, b: int, most_m: float) -> None:
        length = math.dist(self.spots[a], self.spots[b])
        if length <= most_m:
            self._links[a][b] = self._links[b][a] = length

    def _beside(self, node: int) -> Iterator[int]:
        """Later nodes in the squares around one."""
        floor, column, row = self._square(self.nodes[node])
        reach = math.ceil(_BESIDE_M / _CELL_M)
        for x in range(column - reach, column + reach + 1):
            for y in range(row - reach, row + reach + 1):
                other = self._of.get((floor, x, y))
                if other is not None and other > node:
                    yield other


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
