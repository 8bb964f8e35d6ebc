"""A robot's drive: the stops of a run, the poses along it, and its keyframes.

Stops: run ``a`` explores; it looks around at every viewpoint of every room and of the hall, and at
the end in the wide opening between living and dining room. Any other run looks around at its first
stop, anywhere in the house, and visits all rooms in its own order, looking around in about half of
them.

Drive: pure pursuit at a point ``_LOOKAHEAD_M`` ahead on the path. The robot turns on the spot while
that point is far off its heading, otherwise it turns while it drives. Time runs in ticks of 50 ms.
A keyframe is due after 0.5 m or 15° since the last one.

Twenty ticks of straight driving are 0.5 m but for the last bits of a sine, which depend on the C
library. So every threshold has a slack of a micrometre or a microradian (``_SLACK``): values that
are equal in exact arithmetic are treated alike on every machine.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .floorplan import HALL, OPENING_M, Point, Room, wrap
from .grid import DriveGrid
from .house import House
from .random_streams import bernoulli, stream, uniform

EXPLORER = "a"
_TWO_VIEWS_FROM_M = 5.0
_SEARCH_M = 1.2
_MOVE_M = 0.6


@dataclass(frozen=True, slots=True)
class Stop:
    """A spot to drive to, and whether to turn around once there."""

    spot: Point
    look_around: bool


def plan_tour(house: House, run: str) -> tuple[Stop, ...]:
    """The stops of ``run``; it starts at the first."""
    return _explore(house) if run == EXPLORER else _revisit(house, run)


def _explore(house: House) -> tuple[Stop, ...]:
    views = [spot for room in house.plan.rooms for spot in _viewpoints(house, room)]
    hall = _viewpoints(house, house.plan.room(HALL))
    here = hall[0]
    stops = [Stop(here, look_around=True)]
    left = [view for view in views if view != here]
    while left:  # next the nearest unseen viewpoint, by the length of the route
        here = nearest_by_route(house.grid, here, left)
        left.remove(here)
        stops.append(Stop(here, look_around=True))
    return (*stops, Stop(_opening(house), look_around=True))


def _revisit(house: House, run: str) -> tuple[Stop, ...]:
    rng = stream("tour", house.seed, run)
    rooms = [house.plan.rooms[index] for index in rng.permutation(len(house.plan.rooms)).tolist()]
    stops = [
        Stop(_moved_spot(house, room, spot, rng), bernoulli(rng, 0.5))
        for room in rooms
        for spot in _viewpoints(house, room)
    ]
    return (Stop(stops[0].spot, look_around=True), *stops[1:])


def _viewpoints(house: House, room: Room) -> list[Point]:
    """One spot with clearance near the middle; two in a long room."""
    rect = room.rect
    x, y = rect.centre
    wanted = [(x, y)]
    if max(rect.width, rect.height) >= _TWO_VIEWS_FROM_M:
        quarter = rect.width / 4
        wanted = [(rect.x0 + quarter, y), (rect.x1 - quarter, y)]
    return [house.grid.clearest(spot, rect, _SEARCH_M) for spot in wanted]


def _moved_spot(house: House, room: Room, spot: Point, rng: np.random.Generator) -> Point:
    """A random free spot up to ``_MOVE_M`` from ``spot`` in x and y; ``spot`` if none is found."""
    for _ in range(50):
        x = round(spot[0] + uniform(rng, -_MOVE_M, _MOVE_M), 2)
        y = round(spot[1] + uniform(rng, -_MOVE_M, _MOVE_M), 2)
        if room.rect.contains(x, y) and house.grid.free(x, y):
            return x, y
    return spot


def _opening(house: House) -> Point:
    door = next(door for door in house.plan.doors if door.width_m == OPENING_M)
    return house.grid.clearest(door.centre, house.plan.outline, 0.5)


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
