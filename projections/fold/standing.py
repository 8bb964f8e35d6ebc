"""Where Objects stand: the place whose floor an Object with an estimated position is on.

Where walls are known, under ``places = "rooms"`` and ``fusion = "evidence"``, this decides which
place an Object is located in; for all others most of its observations do (`relations`).

1.  An Object stands on the first floor on the line from its estimated position to where it was seen
    from last, and on that of the place whose keyframes are nearest by way (`free_floor`).
2.  It changes place when it surely stands elsewhere: when neither its position nor any of the four
    points one standard error from it, in x and in y, is on the floor of the place that it is in.
3.  Its place is decided again when its estimate has moved by its error or more, or the error has
    halved, since it was decided; when a place comes to floor of the region that it stands in; and
    under another map.

An Object that stands on the floor of no place keeps its place; before it has one, most of its
observations decide.
"""

from collections.abc import Callable
from math import isqrt
from typing import NamedTuple, TypeAlias

import numpy as np

from . import State, packed
from .deltas import ObjectEstimated, ObjectOrdinal, PlaceOrdinal
from .free_floor import Block, FreeFloor
from .occupancy import NOWHERE, Point
from .pair_groups import PlaceSurvivors

FloorAt: TypeAlias = Callable[[Point], tuple[int, FreeFloor, Point] | None]
"""For a laid-out position the number of its floor, that floor, and the position on it; None where
no walls are known."""


class _Estimate(NamedTuple):
    x_um: int
    y_um: int
    error_x_um: int
    error_y_um: int
    seen_from: Point


class _Driven:
    """A region of floor that robots were on: the blocks of their poses, in the order of the first
    pose in each, numbered by that, and the places of these, as of then."""

    def __init__(self) -> None:
        self.numbers: dict[Block, int] = {}
        self.places: dict[PlaceOrdinal, None] = {}


class Standing:
    """The reducer."""

    def __init__(self, floor_at: FloorAt, survivors: PlaceSurvivors) -> None:
        """``survivors`` are those of the reducer of places, up to date at every call."""
        self._floor_at = floor_at
        self._survivors = survivors
        # Per Object that stood on the floor of a place: that place; and the other way round.
        self._places: dict[ObjectOrdinal, PlaceOrdinal] = {}
        self._objects: dict[PlaceOrdinal, dict[ObjectOrdinal, None]] = {}
        # Per pose in a place: x, y, and the place it joined.
        self._xs, self._ys, self._joined = packed("q"), packed("q"), packed("i")
        self._estimates: dict[ObjectOrdinal, _Estimate] = {}
        # By number of the floor and region; how many poses were taken into them, and how many
        # before the state was kept; the Objects that stand in a region.
        self._driven: dict[tuple[int, int], _Driven] = {}
        self._taken = self._kept = 0
        self._inside: dict[tuple[int, int], dict[ObjectOrdinal, None]] = {}
        self._region_of: dict[ObjectOrdinal, tuple[int, int]] = {}
        self._due: dict[ObjectOrdinal, None] = {}

    def use_other_map(self) -> None:
        """Use other maps from now on."""
        self._driven, self._inside, self._region_of = {}, {}, {}
        self._taken = self._kept = 0
        self._due = dict.fromkeys(self._estimates)

    def pose_placed(self, x_um: int, y_um: int, place: PlaceOrdinal) -> None:
        """Add a pose that is in a place."""
        self._xs.append(x_um)
        self._ys.append(y_um)
        self._joined.append(place)

    def place_of(self, ordinal: ObjectOrdinal) -> PlaceOrdinal | None:
        """The place that an Object stands in; None if it never stood on the floor of one."""
        return self._places.get(ordinal)

    def place_absorbed(
        self, survivor: PlaceOrdinal, absorbed: PlaceOrdinal
    ) -> dict[ObjectOrdinal, None]:
        """Move the Objects of an absorbed place to its survivor; returns them."""
        moved = self._objects.pop(absorbed, {})
        self._places.update(dict.fromkeys(moved, survivor))
        self._objects.setdefault(survivor, {}).update(moved)
        return moved

    def object_estimated(self, delta: ObjectEstimated, seen_from: Point) -> None:
        """Take an Object's new estimate, if it differs from the last one taken by its error, or if
        its error has halved."""
        x, y, errors = delta.x_um, delta.y_um, (isqrt(delta.var_xx_um2), isqrt(delta.var_yy_um2))
        before = self._estimates.get(delta.object)
        if before is not None:
            is_near = abs(x - before.x_um) <= errors[0] and abs(y - before.y_um) <= errors[1]
            if is_near and 2 * errors[0] > before.error_x_um and 2 * errors[1] > before.error_y_um:
                return
        self._estimates[delta.object] = _Estimate(x, y, *errors, seen_from)
        self._due[delta.object] = None

    def object_absorbed(self, absorbed: ObjectOrdinal) -> None:
        """Drop an Object that became part of another."""
        self._estimates.pop(absorbed, None)
        self._put(absorbed, None)
        self._due.pop(absorbed, None)
        self._leave(absorbed)

    def decide(self) -> list[ObjectOrdinal]:
        """Decide the places that are due; returns the Objects whose place was decided."""
        self._take_poses()
        due, self._due = sorted(self._due), {}
        for ordinal in due:
            self._decide(ordinal, self._estimates[ordinal])
        return due

    def dump(self) -> State:
        """The whole state, to be kept; nothing without poses."""
        if not self._xs:
            return {}
        poses = zip(self._xs, self._ys, self._joined, strict=True)
        return {
            "poses": np.array(list(poses), np.int64),
            "taken": max(self._taken, self._kept),
            "estimates": [
                [ordinal, *each[:4], *each.seen_from] for ordinal, each in self._estimates.items()
            ],
            "places": list(map(list, self._places.items())),
            "regions": [[ordinal, *region] for ordinal, region in self._region_of.items()],
            "due": list(self._due),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for x, y, place in state["poses"].tolist() if state else ():
            self.pose_placed(x, y, place)
        self._kept = state.get("taken", 0)
        for ordinal, x, y, error_x, error_y, from_x, from_y in state.get("estimates", ()):
            self._estimates[ordinal] = _Estimate(x, y, error_x, error_y, (from_x, from_y))
        for ordinal, place in state.get("places", ()):
            self._put(ordinal, place)
        for ordinal, floor, region in state.get("regions", ()):
            self._enter(ordinal, (floor, region))
        self._due = dict.fromkeys(state.get("due", ()))

    def _take_poses(self) -> None:
        """Take new poses into the floors that they are on."""
        for number in range(self._taken, len(self._xs)):
            found = self._floor_at((self._xs[number], self._ys[number]))
            if found is None:
                continue
            floor, ground, at = found
            block = ground.block_at(at)
            if block is None or (label := ground.label(block)) == NOWHERE:
                continue
            region = floor, label
            driven = self._driven.setdefault(region, _Driven())
            driven.numbers.setdefault(block, number)
            place = self._survivors.find(self._joined[number])
            if place not in driven.places:
                is_known = place in set(map(self._survivors.find, driven.places))
                driven.places[place] = None
                if number >= self._kept and not is_known:
                    self._due.update(self._inside.get(region, {}))
        self._taken = len(self._xs)

    def _decide(self, ordinal: ObjectOrdinal, estimate: _Estimate) -> None:
        x, y, error_x, error_y, seen_from = estimate
        self._leave(ordinal)
        found = self._floor_at(seen_from)
        if found is None:
            return
        floor, ground, from_ = found
        x, y = x + from_[0] - seen_from[0], y + from_[1] - seen_from[1]
        block = ground.stand((x, y), from_)
        if block is None:
            return
        self._enter(ordinal, (floor, ground.label(block)))
        place, before = self._place_on(floor, ground, block), self.place_of(ordinal)
        if place is None or place == before:
            return
        if before is not None:
            for dx, dy in ((error_x, 0), (-error_x, 0), (0, error_y), (0, -error_y)):
                beside = ground.stand((x + dx, y + dy), from_)
                if beside is not None and self._place_on(floor, ground, beside) == before:
                    return
        self._put(ordinal, place)

    def _place_on(self, floor: int, ground: FreeFloor, block: Block) -> PlaceOrdinal | None:
        """The place that a block of floor is of; None in a region that no robot was in."""
        driven = self._driven.get((floor, ground.label(block)))
        if driven is None:
            return None
        find = self._survivors.find
        if len({find(place) for place in driven.places}) == 1:
            return find(next(iter(driven.places)))
        numbers = driven.numbers
        blocked = set[PlaceOrdinal]()
        ways = ground.by_straight_way(block, np.fromiter(numbers, np.int64, len(numbers)))
        order = list(numbers.values())
        for index, is_free in ways:
            blocked.add(find(self._joined[order[index]]))
            if is_free or len(blocked) > 1:
                break
        if len(blocked) == 1:  # the nearest is this one, or one of the same place before it
            return blocked.pop()
        number = ground.nearest(block, numbers)
        return None if number is None else find(self._joined[number])

    def _put(self, ordinal: ObjectOrdinal, place: PlaceOrdinal | None) -> None:
        before = self._places.pop(ordinal, None)
        if before is not None:
            del self._objects[before][ordinal]
        if place is not None:
            self._places[ordinal] = place
            self._objects.setdefault(place, {})[ordinal] = None

    def _enter(self, ordinal: ObjectOrdinal, region: tuple[int, int]) -> None:
        self._region_of[ordinal] = region
        self._inside.setdefault(region, {})[ordinal] = None

    def _leave(self, ordinal: ObjectOrdinal) -> None:
        region = self._region_of.pop(ordinal, None)
        if region is not None:
            del self._inside[region][ordinal]
