"""Driving: free floor, routes over it, and the poses of a robot along them.

Routes: A* on a grid, then shortened to straight lines. Cells are 0.1 m. A cell is free when its
centre is at least ``CLEARANCE_M`` from walls and furniture; that is more than the robot's radius,
because the driven path cuts corners a little. Costs are integers (10 straight, 14 diagonal, more
near obstacles), so ties are broken in the same way on every machine.

Drive: pure pursuit at a point ``_LOOKAHEAD_M`` ahead on the path. The robot turns on the spot while
that point is far off its heading, otherwise it turns while it drives. Time runs in ticks of 50 ms.
A keyframe is due after 0.5 m or 15° since the last one.

Twenty ticks of straight driving are 0.5 m but for the last bits of a sine, which depend on the C
library. So every threshold has a slack of a micrometre or a microradian (``_SLACK``): values that
are equal in exact arithmetic are treated alike on every machine.
"""

import heapq
import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eventsrc.base.errors import MapfoldError

from .floorplan import Point, Rect, Walls, rect_clearance, wrap

CLEARANCE_M = 0.28
_COMFORT_M = 0.45
_CELL_M = 0.1
_STEPS = ((1, 0, 10), (-1, 0, 10), (0, 1, 10), (0, -1, 10))
_DIAGONALS = ((1, 1, 14), (1, -1, 14), (-1, 1, 14), (-1, -1, 14))

Cell = tuple[int, int]


class DriveGrid:
    """Free cells of one furnished floor plan."""

    def __init__(self, outline: Rect, walls: Walls, obstacles: Sequence[Rect]) -> None:
        self._outline = outline
        self._columns = math.ceil(outline.width / _CELL_M)
        self._rows = math.ceil(outline.height / _CELL_M)
        centres = np.array(
            [self._centre((i, j)) for j in range(self._rows) for i in range(self._columns)]
        )
        clearance = walls.clearance(centres)
        for rect in obstacles:
            clearance = np.minimum(clearance, rect_clearance(rect, centres))
        self._clearance: list[list[float]] = clearance.reshape(self._rows, self._columns).tolist()
        self._known_neighbours: dict[Cell, list[tuple[Cell, int]]] = {}

    def clearance_at(self, x: float, y: float) -> float:
        """Distance in metres from the cell around (x, y) to the nearest wall or furniture."""
        i, j = self._cell((x, y))
        if not (0 <= i < self._columns and 0 <= j < self._rows):
            return 0.0
        return self._clearance[j][i]

    def free(self, x: float, y: float) -> bool:
        """Whether a route may lead through (x, y)."""
        return self.clearance_at(x, y) >= CLEARANCE_M

    def clearest(self, around: Point, within: Rect, radius_m: float) -> Point:
        """The free spot in ``within`` with most clearance, at most ``radius_m`` from ``around``; of
        equal ones the nearest.

        Raises MapfoldError when no spot there is free.
        """
        best: tuple[float, float, Cell] | None = None
        for cell in self._cells_of(within):
            x, y = self._centre(cell)
            distance = math.hypot(x - around[0], y - around[1])
            space = min(self._clearance[cell[1]][cell[0]], 0.7)
            if distance > radius_m or space < CLEARANCE_M:
                continue
            rank = (-space, distance, cell)
            best = rank if best is None or rank < best else best
        if best is None:
            raise MapfoldError(f"no free floor within {radius_m} m of {around}; try another --seed")
        return self._centre(best[2])

    def connects(self, spots: Sequence[Point]) -> bool:
        """Whether there are routes between all of ``spots``, each moved to free floor nearby."""
        try:
            near = [self.clearest(spot, Rect.around(*spot, 3.0, 3.0), 1.5) for spot in spots]
        except MapfoldError:
            return False
        unreached = {
            (i, j)
            for j, row in enumerate(self._clearance)
            for i, space in enumerate(row)
            if space >= CLEARANCE_M
        }
        frontier = [self._cell(near[0])]
        unreached -= {*frontier}
        while frontier:
            i, j = frontier.pop()
            for di, dj, _ in (*_STEPS, *_DIAGONALS):
                neighbour = (i + di, j + dj)
                if neighbour in unreached:
                    unreached.remove(neighbour)
                    frontier.append(neighbour)
        return unreached.isdisjoint(self._cell(spot) for spot in near)

    def route(self, start: Point, goal: Point) -> list[Point]:
        """Waypoints from ``start`` to ``goal``, both included, joined by clear straight lines.

        Raises MapfoldError when no free floor leads to ``goal``.
        """
        cells = self._a_star(self._cell(start), self._cell(goal))
        points = [start, *(self._centre(cell) for cell in cells[1:-1]), goal]
        shortened = [points[0]]
        index = 0
        while index < len(points) - 1:
            ahead = min(len(points) - 1, index + 60)
            while ahead > index + 1 and not self._is_clear(points[index], points[ahead]):
                ahead -= 1
            shortened.append(points[ahead])
            index = ahead
        return shortened

    def _is_clear(self, a: Point, b: Point) -> bool:
        count = max(2, math.ceil(math.hypot(b[0] - a[0], b[1] - a[1]) / 0.05))
        return all(
            self.clearance_at(a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count)
            >= CLEARANCE_M + 0.03
            for k in range(count + 1)
        )

    def _a_star(self, start: Cell, goal: Cell) -> list[Cell]:
        frontier = [(self._estimate(start, goal), 0, start)]
        cost = {start: 0}
        previous: dict[Cell, Cell] = {}
        estimate = self._estimate
        while frontier:
            _, spent, cell = heapq.heappop(frontier)
            if cell == goal:
                return _path_to(previous, cell)
            if spent > cost[cell]:
                continue
            for neighbour, step in self._neighbours(cell):
                total = spent + step
                if total < cost.get(neighbour, total + 1):
                    cost[neighbour], previous[neighbour] = total, cell
                    heapq.heappush(frontier, (total + estimate(neighbour, goal), total, neighbour))
        raise MapfoldError(f"no way from cell {start} to cell {goal}; try another --seed")

    def _neighbours(self, cell: Cell) -> list[tuple[Cell, int]]:
        """The free cells around ``cell``, each with the cost of a step there."""
        known = self._known_neighbours.get(cell)
        if known is None:
            known = self._known_neighbours[cell] = []
            for di, dj, step in (*_STEPS, *_DIAGONALS):
                i, j = cell[0] + di, cell[1] + dj
                if not (0 <= i < self._columns and 0 <= j < self._rows):
                    continue
                space = self._clearance[j][i]
                if space >= CLEARANCE_M:
                    known.append(((i, j), step if space >= _COMFORT_M else 2 * step))
        return known

    @staticmethod
    def _estimate(a: Cell, b: Cell) -> int:
        dx, dy = abs(a[0] - b[0]), abs(a[1] - b[1])
        return 10 * max(dx, dy) + 4 * min(dx, dy)

    def _cell(self, spot: Point) -> Cell:
        return (
            math.floor((spot[0] - self._outline.x0) / _CELL_M),
            math.floor((spot[1] - self._outline.y0) / _CELL_M),
        )

    def _centre(self, cell: Cell) -> Point:
        return (
            self._outline.x0 + (cell[0] + 0.5) * _CELL_M,
            self._outline.y0 + (cell[1] + 0.5) * _CELL_M,
        )

    def _cells_of(self, rect: Rect) -> Iterator[Cell]:
        low, high = self._cell((rect.x0, rect.y0)), self._cell((rect.x1, rect.y1))
        for j in range(max(low[1], 0), min(high[1] + 1, self._rows)):
            for i in range(max(low[0], 0), min(high[0] + 1, self._columns)):
                yield i, j


def _path_to(previous: dict[Cell, Cell], cell: Cell) -> list[Cell]:
    path = [cell]
    while cell in previous:
        cell = previous[cell]
        path.append(cell)
    return path[::-1]


def nearest_by_route(grid: DriveGrid, start: Point, goals: Sequence[Point]) -> Point:
    """The goal with the shortest route; of several the least.

    No route is shorter than the straight line, so no route is searched to goals that are farther
    away than the shortest route found so far is long.
    """
    best = (math.inf, start)
    for goal in sorted(goals, key=lambda goal: math.dist(start, goal)):
        if math.dist(start, goal) > best[0] + _SLACK:
            break
        route = grid.route(start, goal)
        best = min(best, (sum(math.dist(a, b) for a, b in itertools.pairwise(route)), goal))
    return best[1]


KEYFRAME_M = 0.5
KEYFRAME_RAD = math.radians(15.0)

_TICK_S = 0.05
_STEP_M = 0.5 * _TICK_S
_TURN_RAD = math.radians(40.0) * _TICK_S
_LOOKAHEAD_M = 0.3
_TURN_ONLY_RAD = math.radians(35.0)
_PAUSE_S = 0.5
_SLACK = 1e-6


@dataclass(frozen=True, slots=True)
class TruePose:
    """The true pose of the robot ``time_s`` seconds after its start: metres, radians."""

    time_s: float
    x: float
    y: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class Stop:
    """A spot to drive to, and whether to turn around once there."""

    spot: Point
    look_around: bool


def drive(grid: DriveGrid, stops: Sequence[Stop]) -> Iterator[TruePose]:
    """The pose at every tick of the drive along ``stops``."""
    robot = _Robot(*stops[0].spot)
    yield robot.pose
    for index, stop in enumerate(stops):
        if index:
            yield from robot.follow(grid.route(robot.spot, stop.spot))
        if stop.look_around:
            yield from robot.look_around()


def keyframes(poses: Iterator[TruePose]) -> Iterator[TruePose]:
    """The poses at which a keyframe is due; the first one always is."""
    last: TruePose | None = None
    for pose in poses:
        if last is None or _due(last, pose):
            last = pose
            yield pose


def _due(last: TruePose, pose: TruePose) -> bool:
    if math.hypot(pose.x - last.x, pose.y - last.y) >= KEYFRAME_M - _SLACK:
        return True
    return abs(wrap(pose.yaw_rad - last.yaw_rad)) >= KEYFRAME_RAD - _SLACK


class _Robot:
    def __init__(self, x: float, y: float) -> None:
        self._x, self._y, self._yaw, self._ticks = x, y, 0.0, 0

    @property
    def spot(self) -> Point:
        return self._x, self._y

    @property
    def pose(self) -> TruePose:
        return TruePose(self._ticks * _TICK_S, self._x, self._y, self._yaw)

    def follow(self, path: Sequence[Point]) -> Iterator[TruePose]:
        track = list(_resampled(path))
        target = 0
        while True:
            while (
                target < len(track) - 1
                and math.dist(self.spot, track[target]) < _LOOKAHEAD_M + _SLACK
            ):
                target += 1
            left = math.dist(self.spot, track[target])
            if left < 1e-6:
                return
            self._steer(track[target], left)
            yield self._tick()

    def look_around(self) -> Iterator[TruePose]:
        for _ in range(round(2 * math.pi / _TURN_RAD)):
            self._yaw = wrap(self._yaw + _TURN_RAD)
            yield self._tick()
        self._ticks += round(_PAUSE_S / _TICK_S)

    def _steer(self, target: Point, left: float) -> None:
        error = wrap(math.atan2(target[1] - self._y, target[0] - self._x) - self._yaw)
        if left <= _STEP_M + _SLACK and abs(error) < math.pi / 2:
            self._x, self._y = target  # the last step: arrive
            return
        self._yaw = wrap(self._yaw + max(-_TURN_RAD, min(_TURN_RAD, error)))
        if abs(error) < _TURN_ONLY_RAD + _SLACK:
            step = min(_STEP_M, left) * math.cos(error)
            self._x += step * math.cos(self._yaw)
            self._y += step * math.sin(self._yaw)

    def _tick(self) -> TruePose:
        self._ticks += 1
        return self.pose


def _resampled(path: Sequence[Point]) -> Iterator[Point]:
    for a, b in itertools.pairwise(path):
        count = max(1, math.ceil(math.dist(a, b) / 0.05))
        for k in range(1, count + 1):
            yield a[0] + (b[0] - a[0]) * k / count, a[1] + (b[1] - a[1]) * k / count
