"""Where a run goes: stops in rooms, with or without a look around.

Run ``a`` explores: every viewpoint of every room and of the hall with a look around, and at the
end one more in the wide opening between living and dining room. Any other run starts somewhere in
the house with a look around, as a robot does that was carried there, and then visits all rooms in
its own order, looking around in about half of them.
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np

from .chance import happens, stream, uniform
from .floorplan import HALL, OPENING_M, Room
from .house import House
from .shapes import Point

EXPLORER = "a"
_TWO_VIEWS_FROM_M = 5.0
_SEARCH_M = 1.2
_WANDER_M = 0.6


@dataclass(frozen=True, slots=True)
class Stop:
    """A spot to drive to; ``look_around`` turns once around there."""

    spot: Point
    look_around: bool


def plan_tour(house: House, run: str) -> tuple[Stop, ...]:
    """The stops of this run; the first one is where it starts."""
    return _explore(house) if run == EXPLORER else _revisit(house, run)


def _explore(house: House) -> tuple[Stop, ...]:
    views = [spot for room in house.plan.rooms for spot in _viewpoints(house, room)]
    hall = _viewpoints(house, house.plan.room(HALL))
    here = hall[0]
    stops = [Stop(here, look_around=True)]
    left = [view for view in views if view != here]
    while left:  # the nearest unseen viewpoint next, by the length of the way there
        here = min(left, key=lambda view: (_way_m(house, here, view), view))
        left.remove(here)
        stops.append(Stop(here, look_around=True))
    return (*stops, Stop(_opening(house), look_around=True))


def _revisit(house: House, run: str) -> tuple[Stop, ...]:
    rng = stream("tour", house.seed, run)
    rooms = [house.plan.rooms[index] for index in rng.permutation(len(house.plan.rooms)).tolist()]
    stops = [
        Stop(_wandered(house, room, spot, rng), happens(rng, 0.5))
        for room in rooms
        for spot in _viewpoints(house, room)
    ]
    return (Stop(stops[0].spot, look_around=True), *stops[1:])


def _viewpoints(house: House, room: Room) -> list[Point]:
    """One spot with space around it near the middle; two in a long room."""
    rect = room.rect
    x, y = rect.centre
    wanted = [(x, y)]
    if max(rect.width, rect.height) >= _TWO_VIEWS_FROM_M:
        quarter = rect.width / 4
        wanted = [(rect.x0 + quarter, y), (rect.x1 - quarter, y)]
    return [house.grid.roomiest(spot, rect, _SEARCH_M) for spot in wanted]


def _wandered(house: House, room: Room, spot: Point, rng: np.random.Generator) -> Point:
    """A free spot up to ``_WANDER_M`` from ``spot``: nobody stops twice at the same place."""
    for _ in range(50):
        x = round(spot[0] + uniform(rng, -_WANDER_M, _WANDER_M), 2)
        y = round(spot[1] + uniform(rng, -_WANDER_M, _WANDER_M), 2)
        if room.rect.contains(x, y) and house.grid.free(x, y):
            return x, y
    return spot


def _opening(house: House) -> Point:
    door = next(door for door in house.plan.doors if door.width_m == OPENING_M)
    return house.grid.roomiest(door.centre, house.plan.outline, 0.5)


def _way_m(house: House, start: Point, goal: Point) -> float:
    points = house.grid.route(start, goal)
    return sum(math.dist(a, b) for a, b in itertools.pairwise(points))
