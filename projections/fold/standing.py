"""Where Objects stand: the place whose floor an Object with an estimated position is on.

Where walls are known, under ``places = "rooms"`` and ``fusion = "evidence"``, this decides which
place an Object is located in; for all others most of its observations do (`relations`).

1.  An Object stands on the first floor on the line from its estimated position to the nearest pose
    that it was seen from, and on that of the place whose keyframes are nearest by way
    (`free_floor`). If no robot was in the region of that floor, the first one on the line that a
    robot was in counts instead.
2.  It changes place when it likely stands elsewhere: when of the four points one standard error
    from its position, in x and in y, at most one is on the floor of the place that it is in; from a
    region that no robot was in at once.
3.  Its place is decided again when its estimate has moved by its error or more, or the error has
    halved, since it was decided; when it was seen from nearer; when a robot of another place comes
    nearer to it than all before; and under another map.

An Object that stands on the floor of no place keeps its place; before it has one, most of its
observations decide.
"""

from collections.abc import Callable
from math import isqrt
from typing import Final, NamedTuple, TypeAlias

import numpy as np

from . import State, packed
from .deltas import ObjectEstimated, ObjectOrdinal, PlaceOrdinal
from .free_floor import Block, FreeFloor
from .map_regions import NOWHERE
from .occupancy import Point
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


class _Ground(NamedTuple):
    """Where an Object stands: the region by its ``label``, and the block whose place it is in. A
    pose of another place affects that if ``reach`` from the block or less."""

    floor: int
    label: int
    block: Block
    reach: int


_MOST_BESIDE: Final = 1
"""So many of the four points beside an Object may be on the floor of the place that it leaves."""
_ANY: Final = 1 << 30
"""The reach of an Object of which only the place, not the nearest pose is known."""


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
        # By number of the floor and region that robots were on: the blocks of their poses, in the
        # order of the first pose in each, numbered by that; and the places of these, as of then.
        self._driven: dict[int, dict[int, dict[Block, int]]] = {}
        self._places_on: dict[tuple[int, int], dict[PlaceOrdinal, None]] = {}
        # How many poses were taken into them, and how many before the state was kept.
        self._taken = self._kept = 0
        # The Objects that stand in a region, `NOWHERE` for all regions that no robot was on.
        self._inside: dict[tuple[int, int], dict[ObjectOrdinal, _Ground]] = {}
        self._region_of: dict[ObjectOrdinal, tuple[int, int]] = {}
        self._due: dict[ObjectOrdinal, None] = {}

    def use_other_map(self) -> None:
        """Use other maps from now on."""
        self._driven, self._places_on, self._inside, self._region_of = {}, {}, {}, {}
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
        """Take an Object's new estimate, if it differs from the last one taken by its error, if its
        error has halved, or if it was seen from nearer."""
        x, y, errors = delta.x_um, delta.y_um, (isqrt(delta.var_xx_um2), isqrt(delta.var_yy_um2))
        before = self._estimates.get(delta.object)
        if before is not None and _is_nearer((x, y), before.seen_from, seen_from):
            seen_from = before.seen_from
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
            "grounds": [
                [ordinal, region, *ground]
                for (_, region), inside in self._inside.items()
                for ordinal, ground in inside.items()
            ],
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
        for ordinal, region, *ground in state.get("grounds", ()):
            self._enter(ordinal, region, _Ground(*ground))
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
            driven = self._driven.setdefault(floor, {}).setdefault(label, {})
            if block not in driven:
                driven[block] = number
                self._approach(floor, ground, block, number)
        self._taken = len(self._xs)

    def _approach(self, floor: int, ground: FreeFloor, block: Block, number: int) -> None:
        """Decide the Objects again to which the first pose on a block may be the nearest."""
        label, place = ground.label(block), self._survivors.find(self._joined[number])
        places = self._places_on.setdefault((floor, label), {})
        known = set(map(self._survivors.find, places))
        places[place] = None
        if number < self._kept:
            return
        for region in ((floor, label), (floor, NOWHERE)):
            if region[1] == label and known == {place}:
                continue
            for ordinal, stands in self._inside.get(region, {}).items():
                is_first = stands.label == label and not known
                if is_first or (
                    self._places.get(ordinal) != place
                    and ground.least_way(stands.block, block) <= stands.reach
                ):
                    self._due[ordinal] = None

    def _decide(self, ordinal: ObjectOrdinal, estimate: _Estimate) -> None:
        x, y, error_x, error_y, seen_from = estimate
        was_in = self._leave(ordinal)
        found = self._floor_at(seen_from)
        if found is None:
            return
        floor, ground, from_ = found
        x, y = x + from_[0] - seen_from[0], y + from_[1] - seen_from[1]
        block = ground.stand((x, y), from_)
        if block is None:
            return
        label, driven = ground.label(block), self._driven.get(floor, {})
        region = label if label in driven else NOWHERE
        if region == NOWHERE:
            block = ground.entrance((x, y), from_, driven) or block
        place, reach = self._place_on(floor, ground, block)
        before = self.place_of(ordinal) if was_in is not None and was_in[1] != NOWHERE else None
        if place is not None and before is not None and place != before:
            errors = (error_x, 0), (-error_x, 0), (0, error_y), (0, -error_y)
            besides = (ground.stand((x + dx, y + dy), from_) for dx, dy in errors)
            on = [self._place_on(floor, ground, each)[0] for each in besides if each is not None]
            if on.count(before) > _MOST_BESIDE:  # a pose may also be nearest to one of these
                place, reach = before, reach + 2 * ground.steps(max(error_x, error_y))
        reach = min(reach, _ANY if region == label else ground.reach)
        self._enter(ordinal, region, _Ground(floor, label, block, reach))
        if place is not None:
            self._put(ordinal, place)

    def _place_on(
        self, floor: int, ground: FreeFloor, block: Block
    ) -> tuple[PlaceOrdinal | None, int]:
        """The place that a block of floor is of, and how near a pose of another place must be to
        change that; None in a region that no robot was in."""
        label, find = ground.label(block), self._survivors.find
        numbers = self._driven.get(floor, {}).get(label)
        if numbers is None:
            return None, _ANY
        places = set(map(find, self._places_on[floor, label]))
        if len(places) == 1:
            return places.pop(), _ANY
        blocks, order = np.fromiter(numbers, np.int64, len(numbers)), list(numbers.values())
        near = set[PlaceOrdinal]()
        for index, is_free in ground.by_straight_way(block, blocks):
            near.add(find(self._joined[order[index]]))
            if len(near) > 1:
                break
            if is_free:  # the nearest is this one, or one of the same place before it
                return near.pop(), ground.least_way(block, int(blocks[index]))
        nearest = ground.nearest(block, numbers)
        return (None, _ANY) if nearest is None else (find(self._joined[nearest[0]]), nearest[1])

    def _put(self, ordinal: ObjectOrdinal, place: PlaceOrdinal | None) -> None:
        before = self._places.pop(ordinal, None)
        if before is not None:
            del self._objects[before][ordinal]
        if place is not None:
            self._places[ordinal] = place
            self._objects.setdefault(place, {})[ordinal] = None

    def _enter(self, ordinal: ObjectOrdinal, region: int, ground: _Ground) -> None:
        self._region_of[ordinal] = ground.floor, region
        self._inside.setdefault((ground.floor, region), {})[ordinal] = ground

    def _leave(self, ordinal: ObjectOrdinal) -> tuple[int, int] | None:
        region = self._region_of.pop(ordinal, None)
        if region is not None:
            del self._inside[region][ordinal]
        return region


def _is_nearer(to: Point, one: Point, other: Point) -> bool:
    """Whether one position is as near as another, or nearer."""
    (x, y), (ax, ay), (bx, by) = to, one, other
    return (ax - x) ** 2 + (ay - y) ** 2 <= (bx - x) ** 2 + (by - y) ** 2
