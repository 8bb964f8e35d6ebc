"""Places: online DBSCAN that equals batch DBSCAN after every keyframe.

The rules (Ester et al. 1996, 1998; docs/places.md):

1.  Two poses are neighbours within ε, inclusive; a pose is its own neighbour. A pose with at least
    ``min_samples`` neighbours is *core*. Core points that are neighbours are of one place.
2.  Points are only ever added, so a core point stays core and places only grow or merge.
3.  A newcomer can make itself core, and any of its neighbours. Everything that changes, changes
    around these *fresh* core points. Fresh ones that are connected act as one group; there is one
    group when the newcomer is core (it is a neighbour of all), else there may be several.
4.  A group that touches no older core point founds a place; its founder is its earliest keyframe.
    The place is named by the founder's run and a counter, and numbered in founding order.
5.  A group that touches one place extends it. One that touches several merges them: the one founded
    first survives, whatever the text of its id. A merge names one pair of core points for each
    absorbed place: a fresh one, and one of the place that it reached.
6.  A pose that is not core belongs to a place only by a core neighbour (*border*). It takes the
    place founded first among those in reach when it can first join one, and stays there, unless
    that place is absorbed. Without a core neighbour it is noise, which belongs to no place.

Rule 6 is the only freedom DBSCAN leaves; core points and their partition are unique.

Under ``keep-apart`` and ``join``, `projections.reducers.constrained_places` adds rules.
"""

import math
from bisect import bisect_left
from collections.abc import Iterator, MutableSequence
from typing import NamedTuple

import numpy as np

from eventsrc.envelope import Offset, RunId
from projections.deltas import (
    Delta,
    KeyframeOrdinal,
    KeyframePlaced,
    Link,
    PlaceChanged,
    PlaceFormed,
    PlaceOrdinal,
    PlacesMerged,
    RunOrdinal,
)
from projections.reducers import State, packed, part, prefixed

from .core_index import CoreIndex
from .rule_index import RuleCoreIndex
from .survivors import PlaceSurvivors

NOISE = PlaceOrdinal(-1)
"""What the packed array of places holds for a point in none."""


class Part(NamedTuple):
    """Fresh core points that are of one place, ascending, and the places with an older core point
    in their reach, each with one pair of core points: (a fresh one, one of the place)."""

    cores: list[int]
    touched: dict[PlaceOrdinal, tuple[int, int]]


class Places:
    """The reducer. Points are numbered by arrival among the keyframes that have a pose."""

    def __init__(self, core_index: CoreIndex | RuleCoreIndex) -> None:
        self.core_index = core_index
        # Per point: the place it joined, as of then; its keyframe; its run.
        self.joined: MutableSequence[PlaceOrdinal] = packed("i")
        self.keyframes: MutableSequence[KeyframeOrdinal] = packed("i")
        self.runs: MutableSequence[RunOrdinal] = packed("i")
        # Per run: its id, and how many places it has founded.
        self.run_ids: dict[RunOrdinal, RunId] = {}
        self.founded: dict[RunOrdinal, int] = {}
        self.survivors = PlaceSurvivors()
        # Per place, of its current members:
        self.member_counts: list[int] = []
        self.sums_x_um: list[int] = []
        self.sums_y_um: list[int] = []

    def fold(
        self,
        offset: Offset,
        keyframe: KeyframeOrdinal,
        run: RunOrdinal,
        run_id: RunId,
        x_um: int,
        y_um: int,
        yaw: float,
    ) -> list[Delta]:
        """Add a keyframe with a pose; what it changed, in the order of the delta contract."""
        point = len(self.joined)
        self.joined.append(NOISE)
        self.keyframes.append(keyframe)
        self.runs.append(run)
        self.run_ids[run] = run_id
        fresh = self.core_index.insert(x_um, y_um, yaw)
        if fresh == [point] and (older := self.core_index.enclosing_core(point)) is not None:
            place = self.survivors.find(self.joined[older])
            self._join(point, place)
            return [KeyframePlaced(offset, keyframe, place), self._place_changed(offset, place)]
        return self._fold_changes(offset, point, fresh)

    def _fold_changes(self, offset: Offset, newcomer: int, fresh: list[int]) -> list[Delta]:
        """What a new point that made ``fresh`` core points changes."""
        deltas: list[Delta] = []
        joining = self._joining(offset, newcomer, fresh, deltas)
        find = self.survivors.find
        changed = [d.survivor for d in deltas if type(d) is PlacesMerged]
        for joiner in sorted(joining):
            place = find(joining[joiner])
            self._join(joiner, place)
            changed.append(place)
            deltas.append(KeyframePlaced(offset, self.keyframes[joiner], place))
        deltas += [self._place_changed(offset, place) for place in sorted({*map(find, changed)})]
        return deltas

    def label(self, point: int) -> PlaceOrdinal | None:
        """The point's current place; None for noise."""
        joined = self.joined[point]
        return None if joined == NOISE else self.survivors.find(joined)

    def place_of(self, keyframe: KeyframeOrdinal) -> PlaceOrdinal | None:
        """A keyframe's current place; None for noise, or without a pose."""
        point = self._point_of(keyframe)
        is_there = point < len(self.keyframes) and self.keyframes[point] == keyframe
        return self.label(point) if is_there else None

    def dump(self) -> State:
        """Everything, for a snapshot."""
        absorbed_by, places = self.survivors.absorbed_by, range(len(self.member_counts))
        own = {
            "joined": np.array(self.joined, np.int32),
            "keyframes": np.array(self.keyframes, np.int32),
            "runs": np.array(self.runs, np.int32),
            "run_ids": [[run, run_id] for run, run_id in self.run_ids.items()],
            "founded": [[run, count] for run, count in self.founded.items()],
            "survivors": [absorbed_by.get(PlaceOrdinal(p), p) for p in places],
            "member_counts": self.member_counts,
            "sums_x_um": self.sums_x_um,
            "sums_y_um": self.sums_y_um,
        }
        return own | prefixed("crowd", self.core_index.dump())

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self.joined = packed("i", state["joined"].tobytes())
        self.keyframes = packed("i", state["keyframes"].tobytes())
        self.runs = packed("i", state["runs"].tobytes())
        self.run_ids = dict(state["run_ids"])
        self.founded = dict(state["founded"])
        parents = enumerate(state["survivors"])
        self.survivors.absorbed_by = {PlaceOrdinal(p): s for p, s in parents if p != s}
        self.member_counts = state["member_counts"]
        self.sums_x_um = state["sums_x_um"]
        self.sums_y_um = state["sums_y_um"]
        self.core_index.load(part("crowd", state))

    def _point_of(self, keyframe: KeyframeOrdinal) -> int:
        """A keyframe's point; of one without a pose, that of the next."""
        return bisect_left(self.keyframes, keyframe)

    def _joining(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, PlaceOrdinal]:
        """Change places and append the deltas; by point, the place that it joins."""
        joining = self._cluster(offset, newcomer, fresh, deltas) if fresh else {}
        if newcomer not in joining:
            earliest = self._earliest_in_reach(newcomer)
            if earliest is not None:
                joining[newcomer] = earliest
        return joining

    def _cluster(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, PlaceOrdinal]:
        """Found, extend and merge places around the fresh core points (rules 3 to 5).

        Appends the deltas; returns, by point, the place that it joins.
        """
        joining: dict[int, PlaceOrdinal] = {}
        for group, touched in self._parts(newcomer, fresh):
            if not touched:
                place = self._form_place(offset, group[0], deltas)
            else:
                place = min(touched)
                if len(touched) > 1:
                    deltas.append(self._merge(offset, newcomer, place, touched))
            for core in group:
                if self.joined[core] == NOISE:
                    joining[core] = place
                for other in self.core_index.non_core_around(core):
                    if self.joined[other] == NOISE and other != newcomer:
                        earlier = self.survivors.find(joining.get(other, place))
                        joining[other] = min(place, earlier)
        for core in fresh:  # for `_earliest_in_reach`, should the newcomer not be core
            if self.joined[core] == NOISE:
                self.joined[core] = joining[core]
        return joining

    def _parts(self, newcomer: int, fresh: list[int]) -> Iterator[Part]:
        """The connected groups of fresh core points; each sees what was merged for the last."""
        for group in self._connected_groups(newcomer, fresh):
            yield Part(group, self._places_touched(group, fresh))

    def _connected_groups(self, newcomer: int, fresh: list[int]) -> Iterator[list[int]]:
        """The fresh core points in connected groups, each ascending, ordered by their earliest."""
        if fresh[-1] == newcomer or len(fresh) == 1:
            yield fresh
            return
        rest = fresh
        while rest:
            group, frontier = [rest[0]], [rest[0]]
            rest = rest[1:]
            while frontier:
                core = frontier.pop()
                near = [other for other in rest if self.core_index.are_neighbours(core, other)]
                rest = [other for other in rest if other not in near]
                group += near
                frontier += near
            yield sorted(group)

    def _places_touched(
        self, group: list[int], fresh: list[int]
    ) -> dict[PlaceOrdinal, tuple[int, int]]:
        """The places with an older core point in reach of the group, each with one pair of core
        points: (a fresh one, one of the place)."""
        touched: dict[PlaceOrdinal, tuple[int, int]] = {}
        index, joined, find = self.core_index, self.joined, self.survivors.find
        for core in group:
            own = NOISE
            for first, cell in index.cores_around(core):
                place = joined[first]
                if place == NOISE or first in fresh:
                    continue
                place = find(place)
                if cell is None:
                    own = place
                    touched.setdefault(place, (core, first))
                elif place == own:
                    index.mark_one_cluster(core, cell)
                elif place not in touched:
                    neighbour = index.core_in_reach(cell, core)
                    if neighbour is not None:  # a fresh one has the older ``first`` beside it
                        pair = (neighbour, first) if neighbour in fresh else (core, neighbour)
                        touched[place] = pair
        return touched

    def _earliest_in_reach(self, point: int) -> PlaceOrdinal | None:
        """The place a newcomer that is not core joins (rule 6); None for noise."""
        index, earliest = self.core_index, None
        for first, cell in index.cores_around(point):
            place = self.survivors.find(self.joined[first])
            if earliest is not None and earliest < place:
                continue
            if cell is None or index.core_in_reach(cell, point) is not None:
                earliest = place
        return earliest

    def _form_place(self, offset: Offset, founder: int, deltas: list[Delta]) -> PlaceOrdinal:
        place, run = PlaceOrdinal(len(self.member_counts)), self.runs[founder]
        counter = self.founded.get(run, 0)
        self.founded[run] = counter + 1
        self.member_counts.append(0)
        self.sums_x_um.append(0)
        self.sums_y_um.append(0)
        place_id = f"{self.run_ids[run]}_p{counter}"
        deltas.append(PlaceFormed(offset, place, place_id, self.keyframes[founder]))
        return place

    def _merge(
        self,
        offset: Offset,
        newcomer: int,
        survivor: PlaceOrdinal,
        touched: dict[PlaceOrdinal, tuple[int, int]],
    ) -> PlacesMerged:
        absorbed = tuple(sorted(place for place in touched if place != survivor))
        counts = self.member_counts
        delta = PlacesMerged(
            offset,
            survivor,
            absorbed,
            bridge=self.keyframes[newcomer],
            links=tuple(self._link(*touched[place]) for place in absorbed),
            survivor_count=counts[survivor],
            absorbed_counts=tuple(counts[place] for place in absorbed),
        )
        self.survivors.merge(survivor, absorbed)
        for place in absorbed:
            counts[survivor] += counts[place]
            self.sums_x_um[survivor] += self.sums_x_um[place]
            self.sums_y_um[survivor] += self.sums_y_um[place]
        return delta

    def _link(self, core: int, neighbour: int) -> Link:
        distance_um = math.isqrt(self.core_index.squared_distance(core, neighbour))
        return Link(self.keyframes[core], self.keyframes[neighbour], distance_um)

    def _join(self, point: int, place: PlaceOrdinal) -> None:
        self.joined[point] = place
        self.member_counts[place] += 1
        self.sums_x_um[place] += self.core_index.x[point]
        self.sums_y_um[place] += self.core_index.y[point]

    def _place_changed(self, offset: Offset, place: PlaceOrdinal) -> PlaceChanged:
        return PlaceChanged(
            offset,
            place,
            self.member_counts[place],
            self.sums_x_um[place],
            self.sums_y_um[place],
        )
