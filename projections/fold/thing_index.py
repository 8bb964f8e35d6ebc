"""Index of all Objects of fusion by evidence, by estimated position.

An Object is within reach of a point at most ``reach_m`` from its estimate. Each is listed in the
nine cells of that side around its estimate, so one look-up finds all that are within reach.

A thing whose estimate is sure gives its class the logarithm of its size and its elevation above the
camera. The next thing of the class starts from their mean, so that one uncut box gives its
distance. The sums are integers, and a thing's older values are subtracted before new ones are
added: the result depends on the latest values only, not on their order.
"""

from collections.abc import Iterable, Mapping
from struct import pack_into

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import Offset

from . import State, part, prefixed
from .deltas import ObjectEstimated, ObjectOrdinal
from .evidence import EvidenceConstants
from .exact import exp, log
from .looks import Floats
from .spots import PART_SIZE, Estimate, HeightPrior, Part, Solver, Spot, Spots
from .things import ROW, FusedThing, Given

_REACH_SPREADS, _REACH_MORE_M = 1.5, 1.5
_UM, _UM2 = 1e6, 1e12
_FIELDS = len(Estimate._fields)
_ROW, _ROW_BYTES = f"{_FIELDS}d", _FIELDS * 8

_UNIT = 1 << 16
_UNKNOWN = 3.0
"""The number of things that the prior spread weighs as much as."""
_SPREAD = 0.3
_SURE_M2 = 0.15
_SURE_SIZE = 0.1
UNKNOWN_CLASS = HeightPrior(-0.4, 2.0, 0.0, 0.25)


class ClassHeights:
    """Sums over the sure things of each class."""

    def __init__(self, sizes_m: Mapping[str, float], size_spread: float) -> None:
        weight = 1.0 / (size_spread * size_spread)
        self._stated = {
            name: HeightPrior(log(size), weight, 0.0, UNKNOWN_CLASS.elevation_weight)
            for name, size in sizes_m.items()
        }
        self._sums: dict[str, list[int]] = {}

    def prior(self, class_name: str) -> HeightPrior:
        """The prior of a thing of this class."""
        stated = self._stated.get(class_name, UNKNOWN_CLASS)
        sums = self._sums.get(class_name)
        if sums is None or sums[0] == 0:
            return stated
        count, sizes, sizes2, elevations, elevations2 = sums
        share = (1.0 + 1.0 / count) / (count + _UNKNOWN - 1.0)
        elevation, spread = _moments(count, elevations, elevations2)
        of_elevation = elevation, 1.0 / ((spread + _UNKNOWN * _SPREAD * _SPREAD) * share)
        if class_name in self._stated:
            return HeightPrior(stated[0], stated[1], *of_elevation)
        log_size, spread = _moments(count, sizes, sizes2)
        weight = 1.0 / ((spread + _UNKNOWN * _SPREAD * _SPREAD) * share)
        return HeightPrior(log_size, weight, *of_elevation)

    def give(
        self,
        before: Given | None,
        class_name: str,
        log_size: float,
        size_variance: float,
        elevation: float,
        variance_m2: float,
        spots: int,
    ) -> Given | None:
        """Replace the values that a thing added before; by nothing if its estimate is not sure
        enough."""
        if spots < 2 or variance_m2 >= _SURE_M2 or size_variance >= _SURE_SIZE:
            if before is not None:
                self._add(before, -1)
            return None
        given = class_name, round(log_size * _UNIT), round(elevation * _UNIT)
        if given != before:
            if before is not None:
                self._add(before, -1)
            self._add(given, 1)
        return given

    def remove(self, given: Given) -> None:
        """Subtract the values that a thing added."""
        self._add(given, -1)

    def _add(self, given: Given, sign: int) -> None:
        class_name, size, elevation = given
        sums = self._sums.get(class_name)
        if sums is None:
            sums = self._sums[class_name] = [0, 0, 0, 0, 0]
        sums[0] += sign
        sums[1] += sign * size
        sums[2] += sign * size * size
        sums[3] += sign * elevation
        sums[4] += sign * elevation * elevation

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {"sums": sorted([name, *sums] for name, sums in self._sums.items())}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._sums = {name: list(sums) for name, *sums in state["sums"]}


def _moments(count: int, total: int, squares: int) -> tuple[float, float]:
    """Mean and sum of squared deviations."""
    return total / (count * _UNIT), (count * squares - total * total) / (count * _UNIT * _UNIT)


class ThingIndex:
    """Objects by ordinal, their estimates as rows of one matrix, and the grid. Absorbed ones are
    None."""

    def __init__(self, constants: EvidenceConstants) -> None:
        spreads = exp(_REACH_SPREADS * constants.range_spread)
        self.reach_m = constants.range_m * spreads + _REACH_MORE_M
        self._solver = Solver(constants.range_m, constants.range_spread)
        self._heights = ClassHeights(constants.sizes_m, constants.size_spread)
        self._things: list[FusedThing | None] = []
        self._survivors: dict[ObjectOrdinal, ObjectOrdinal] = {}
        self._near: dict[tuple[int, int], list[ObjectOrdinal]] = {}
        self._sorted: dict[tuple[int, int], NDArray[np.int64]] = {}  # `_near` as arrays
        self.estimates: Floats = np.zeros((64, _FIELDS))

    def thing(self, ordinal: ObjectOrdinal) -> FusedThing:
        """An Object that is not absorbed."""
        thing = self._things[ordinal]
        if thing is None:
            raise KeyError(f"object {ordinal} was merged into {self._survivors[ordinal]}")
        return thing

    def survivor_of(self, ordinal: ObjectOrdinal) -> ObjectOrdinal:
        """The Object's survivor after all merges."""
        while ordinal in self._survivors:
            ordinal = self._survivors[ordinal]
        return ordinal

    def add(self, thing: FusedThing) -> ObjectOrdinal:
        """Enter a new Object; `solve` must follow."""
        ordinal = ObjectOrdinal(len(self._things))
        self._things.append(thing)
        self._make_room(len(self._things))
        return ordinal

    def solve(self, ordinal: ObjectOrdinal, thing: FusedThing, spot: int | None = None) -> None:
        """Estimate an Object's position after one spot changed, or all (None), and list it
        there."""
        prior = self._heights.prior(thing.class_name)
        before = thing.estimate
        if before is None:
            made = self._solver.first(thing.spots, prior)
        else:
            made = self._solver.next(thing.spots, prior, before, spot)
        thing.estimate = made
        pack_into(_ROW, self.estimates.data, ordinal * _ROW_BYTES, *made)
        x, y, xx, _, yy, log_size, _, _, log_size_variance, elevation, *_ = made
        cell = int(x // self.reach_m), int(y // self.reach_m)
        if before is None or cell != thing.cell:
            if before is not None:
                self._unlist(ordinal, thing.cell)
            self._list(ordinal, thing, cell)
        thing.given = self._heights.give(
            thing.given,
            thing.class_name,
            log_size,
            log_size_variance,
            elevation,
            xx + yy,
            thing.spots.seen_from,
        )

    def listed(self, x: float, y: float) -> NDArray[np.int64]:
        """The Objects within reach of a point and some more, ascending; cached until the index
        changes."""
        cell = int(x // self.reach_m), int(y // self.reach_m)
        ordinals = self._sorted.get(cell)
        if ordinals is None:
            ordinals = self._sorted[cell] = np.array(sorted(self._near.get(cell, ())), np.int64)
        return ordinals

    def count_meetings(self, seen: list[ObjectOrdinal]) -> None:
        """Count a picture that shows all of these Objects."""
        things = [self.thing(ordinal).met for ordinal in seen]
        for index, (one, met) in enumerate(zip(seen, things, strict=True)):
            for other, met_too in zip(seen[:index], things, strict=False):
                if one != other:
                    met[other] = met_too[one] = met.get(other, 0) + 1

    def unite(self, survivor: ObjectOrdinal, absorbed: ObjectOrdinal) -> None:
        """Merge two Objects."""
        thing, other = self.thing(survivor), self.thing(absorbed)
        self._unlist(absorbed, other.cell)
        if other.given is not None:
            self._heights.remove(other.given)
        self._things[absorbed] = None
        self._survivors[absorbed] = survivor
        thing.absorb(other)
        thing.met.pop(absorbed, None)
        for third, count in other.met.items():
            if third != survivor:
                met = self.thing(third).met
                del met[absorbed]
                thing.met[third] = met[survivor] = thing.met.get(third, 0) + count
        self.solve(survivor, thing)

    def estimated(self, offset: Offset, ordinal: ObjectOrdinal) -> ObjectEstimated:
        """The delta of an Object's estimate."""
        thing = self.thing(ordinal)
        x, y, xx, xy, yy, *_ = thing.where()
        return ObjectEstimated(
            offset,
            ordinal,
            round(x * _UM),
            round(y * _UM),
            round(xx * _UM2),
            round(xy * _UM2),
            round(yy * _UM2),
            thing.spots.seen_from,
        )

    def _make_room(self, count: int) -> None:
        while len(self.estimates) < count:
            self.estimates = np.concatenate([self.estimates, self.estimates * 0.0])

    def _list(self, ordinal: ObjectOrdinal, thing: FusedThing, cell: tuple[int, int]) -> None:
        thing.cell = cell
        for around in _around(cell):
            self._near.setdefault(around, []).append(ordinal)
            self._sorted.pop(around, None)

    def _unlist(self, ordinal: ObjectOrdinal, cell: tuple[int, int]) -> None:
        for around in _around(cell):
            self._near[around].remove(ordinal)
            self._sorted.pop(around, None)

    def dump(self) -> State:
        """The whole state, to be kept. The looks are one matrix, a row for each exemplar."""
        alive = [(o, thing) for o, thing in enumerate(self._things) if thing is not None]
        things = [thing for _, thing in alive]
        looks = [t.looks[[mark[ROW] for mark in t.marks]] for t in things if t.marks]
        marks = [mark[:ROW] for thing in things for mark in thing.marks]
        spots = [spot + part for t in things for spot, part in _spots_and_parts(t)]
        return {
            "size": len(self._things),
            "survivors": sorted(map(list, self._survivors.items())),
            "ordinals": [ordinal for ordinal, _ in alive],
            "sums": [
                [t.count, t.sum_x_um, t.sum_y_um, t.checked, len(t.marks), len(t.spots.spots)]
                for t in things
            ],
            "spots_ever": [thing.spots.seen_from for thing in things],
            "seen": np.array([(t.first_seen, t.last_seen) for t in things]).reshape(-1, 2),
            "classes": [[t.class_name, *map(list, t.classes.items())] for t in things],
            "met": [sorted(map(list, thing.met.items())) for thing in things],
            "groups": [sorted(thing.groups) for thing in things],
            "given": [thing.given for thing in things],
            "estimates": np.array([thing.estimate for thing in things]),
            "spots": np.array(spots),
            "normal": np.array([[*t.spots.at, *t.spots.total] for t in things]),
            "looks": np.concatenate(looks).astype(np.int16) if looks else np.zeros((0, 0)),
            "marks": np.array(marks, np.float64).reshape(-1, ROW),
        } | prefixed("heights", self._heights.dump())

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._things = [None] * state["size"]
        self._survivors = {ObjectOrdinal(a): ObjectOrdinal(b) for a, b in state["survivors"]}
        self._heights.load(part("heights", state))
        self._make_room(state["size"])
        looks, marks, spots = state["looks"], state["marks"].tolist(), state["spots"].tolist()
        seen, estimates = state["seen"].tolist(), state["estimates"].tolist()
        first_look = first_spot = 0
        for row, ordinal in enumerate(state["ordinals"]):
            count, x, y, checked, exemplars, spot_count = state["sums"][row]
            name, *classes = state["classes"][row]
            given = state["given"][row]
            thing = FusedThing(
                count,
                x,
                y,
                seen[row][0],
                seen[row][1],
                name,
                dict(classes),
                Spots(),
                looks[first_look : first_look + exemplars].astype(np.float32),
                [
                    (inverse, cos, sin, int(run), int(kind), number)
                    for number, (inverse, cos, sin, run, kind) in enumerate(
                        marks[first_look : first_look + exemplars]
                    )
                ],
                met={ObjectOrdinal(other): n for other, n in state["met"][row]},
                checked=checked,
                given=None if given is None else (given[0], given[1], given[2]),
                estimate=Estimate(*estimates[row]),
                groups=set(state["groups"][row]),
            )
            thing.spots.seen_from = state["spots_ever"][row]
            for numbers in spots[first_spot : first_spot + spot_count]:
                thing.spots.spots.append(numbers[:-PART_SIZE])
                thing.spots.parts.append(numbers[-PART_SIZE:])
            at_x, at_y, *thing.spots.total = state["normal"][row].tolist()
            thing.spots.at = at_x, at_y
            first_look, first_spot = first_look + exemplars, first_spot + spot_count
            self._things[ordinal] = thing
            self.estimates[ordinal] = estimates[row]
            cell = (
                int(estimates[row][0] // self.reach_m),
                int(estimates[row][1] // self.reach_m),
            )
            self._list(ObjectOrdinal(ordinal), thing, cell)


def _spots_and_parts(thing: FusedThing) -> Iterable[tuple[Spot, Part]]:
    return zip(thing.spots.spots, thing.spots.parts, strict=True)


def _around(cell: tuple[int, int]) -> Iterable[tuple[int, int]]:
    return ((cell[0] + dx, cell[1] + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1))
