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

Under ``keep-apart`` and ``join``, `projections.fold.constrained_places` adds rules.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

from eventsrc.envelope.model import Offset

from . import State, part, prefixed
from .core_index import CoreIndex
from .deltas import Delta, KeyframePlaced, PlaceLink, PlaceOrdinal, PlacesMerged
from .place_members import NOISE, PlaceMembers, PosedKeyframe


class Part(NamedTuple):
    """Fresh core points that are of one place, ascending, and the places with an older core point
    in their reach, each with one pair of core points: (a fresh one, one of the place)."""

    cores: list[int]
    touched: dict[PlaceOrdinal, tuple[int, int]]


class Places(PlaceMembers):
    """The reducer."""

    def __init__(self, core_index: CoreIndex) -> None:
        super().__init__()
        self.core_index = core_index

    def fold(self, posed: PosedKeyframe) -> list[Delta]:
        """Add a keyframe with a pose; returns the deltas in the order of `fold.deltas`."""
        offset, keyframe, run, run_id, x_um, y_um = posed
        point = self.add_point(keyframe, run, run_id)
        fresh = self.core_index.insert(x_um, y_um)
        if fresh == [point] and (older := self.core_index.enclosing_core(point)) is not None:
            place = self.survivors.find(self.joined[older])
            self._join(point, place)
            return [KeyframePlaced(offset, keyframe, place), self.place_changed(offset, place)]
        return self._fold_changes(offset, point, fresh)

    def _fold_changes(self, offset: Offset, newcomer: int, fresh: list[int]) -> list[Delta]:
        """The deltas of a new point that made ``fresh`` points core."""
        deltas: list[Delta] = []
        joining = self._joining(offset, newcomer, fresh, deltas)
        find = self.survivors.find
        changed = [d.survivor for d in deltas if type(d) is PlacesMerged]
        for joiner in sorted(joining):
            place = find(joining[joiner])
            self._join(joiner, place)
            changed.append(place)
            deltas.append(KeyframePlaced(offset, self.keyframes[joiner], place))
        deltas += [self.place_changed(offset, place) for place in sorted({*map(find, changed)})]
        return deltas

    def dump(self) -> State:
        """The whole state, to be kept."""
        return super().dump() | prefixed("crowd", self.core_index.dump())

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        super().load(state)
        self.core_index.load(part("crowd", state))

    def _joining(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, PlaceOrdinal]:
        """Change places, append the deltas, and return the place that each point joins."""
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
                formed = self.form_place(offset, group[0])
                deltas.append(formed)
                place = formed.place
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
        """The connected groups of fresh core points, lazily: each uses the merges of the one
        before."""
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
        self.absorb(survivor, absorbed)
        return delta

    def _link(self, core: int, neighbour: int) -> PlaceLink:
        distance_um = math.isqrt(self.core_index.squared_distance(core, neighbour))
        return PlaceLink(self.keyframes[core], self.keyframes[neighbour], distance_um)

    def _join(self, point: int, place: PlaceOrdinal) -> None:
        self.join_place(point, place, self.core_index.x[point], self.core_index.y[point])
