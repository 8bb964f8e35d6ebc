"""Places under ``keep-apart``, ``undo-merge`` and ``join``: constrained online DBSCAN.

The rules of `projections.fold.places` hold, whose code is reused, and further:

7.  *Anchors* are the keyframes that the commands name. An anchor is in the place that it belongs to
    by the rules. Places with anchors that are kept apart *conflict*; they are never merged. Which
    points are core does not depend on it, nor who founds a place that nothing older touches.
8.  Core points that share a cell of the grid (side ε/√2, `core_index`) are always of one place. So
    cells with core points are what is clustered. A cell keeps its place once it has one. Two
    anchors in one cell cannot be kept apart, nor can one that arrives in a cell of the other's
    place.
9.  Where fresh core points touch places that conflict, their cells are taken in like this. A fresh
    cell with points that are in a place already is of that place, of the one founded first if there
    are several. Then the links between cells that fresh core points make are followed: those of the
    place founded first come first, to the places in founding order and then to fresh cells, ordered
    by their earliest fresh core point; then those of the next place; last, those between fresh
    cells. A link that would bring anchors together that are kept apart is refused; it stays so, for
    places only grow. What is linked then is one place, as in rules 4 and 5.
10. A keyframe that is in a place stays there (rule 6), also if it becomes core in a cell of
    another. An anchor that is not core joins the place founded first among those in reach that do
    not conflict with it.
11. Places with anchors that are joined become one as soon as both have one, after all else that the
    event does to core points. It is refused if the places conflict.

A refused link is a `MergeRefused`, once for each pair of places. Where nothing conflicts the deltas
are those of `Places`.
"""

from collections.abc import Iterator
from itertools import combinations, product
from typing import NamedTuple, TypeAlias

import msgspec

from eventsrc.envelope.model import Offset

from . import State
from .core_index import CoreIndex
from .corrections import Keyframe
from .deltas import Delta, KeyframeOrdinal, KeyframePlaced, MergeRefused, PlaceOrdinal, PlacesMerged
from .exact import metres_to_um
from .pair_groups import PairGroups
from .place_members import NOISE, Apart, Inside, PlaceAnchors, PosedKeyframe
from .places import Part, Places
from .rooms import Rooms
from .settings import Settings

Rank: TypeAlias = tuple[int, int]
"""The order of what is clustered: (0, place), or (1, earliest fresh core point of a fresh cell)."""


class CellLink(NamedTuple):
    """Two cells with core points in reach of each other, by their first core points, and the pair
    that shows it: a fresh core point of ``cell`` and a core point of ``near``."""

    cell: int
    near: int
    core: int
    neighbour: int


class RefusedLink(NamedTuple):
    """A link that was not followed, and the anchors on its two sides that are kept apart."""

    link: CellLink
    apart: Apart


class ConstrainedPlaces(Places):
    """The reducer of places under pairs of anchors. `add_anchor` precedes `fold` of the anchor's
    keyframe."""

    def __init__(self, core_index: CoreIndex, groups: PairGroups[Keyframe]) -> None:
        super().__init__(core_index)
        self._anchors = PlaceAnchors(groups)
        # Refused links by first core points of cells, both ways round: known to change nothing
        # while the places are the same.
        self._refused_links: set[tuple[int, int]] = set()
        # Of the event that is being folded:
        self._refusals: list[RefusedLink] = []
        self._undecided: list[int] = []  # anchors that are not core and could join a place

    def add_anchor(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """Register a keyframe as an anchor, if it is one."""
        self._anchors.add(keyframe, anchor)

    def fold(self, posed: PosedKeyframe) -> list[Delta]:
        """As `Places.fold`."""
        offset, keyframe, run, run_id, x_um, y_um = posed
        if keyframe not in self._anchors:
            return super().fold(posed)
        point = self.add_point(keyframe, run, run_id)
        return self._fold_changes(offset, point, self.core_index.insert(x_um, y_um))

    def dump(self) -> State:
        """The whole state, to be kept."""
        return super().dump() | self._anchors.dump()

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        super().load(state)
        self._anchors.load(state, self.place_of)

    def _fold_changes(self, offset: Offset, newcomer: int, fresh: list[int]) -> list[Delta]:
        if self._refused_links and fresh == [newcomer] and not self._is_anchor(newcomer):
            older = self.core_index.enclosing_core_beside(newcomer, self._refused_links)
            if older is not None:
                place = self.survivors.find(self.joined[older])
                self._join(newcomer, place)
                placed = KeyframePlaced(offset, self.keyframes[newcomer], place)
                return [placed, self.place_changed(offset, place)]
        return super()._fold_changes(offset, newcomer, fresh)

    def _joining(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, PlaceOrdinal]:
        if not self._anchors.have_come:
            return super()._joining(offset, newcomer, fresh, deltas)
        self._refusals, self._undecided = [], []
        joining = super()._joining(offset, newcomer, fresh, deltas)
        entered = {p: joining[p] for p in fresh if p in joining and self._is_anchor(p)}
        for point, place in entered.items():
            self._enter_point(point, place)
        for point in sorted(self._undecided):
            free = self._first_without_conflict(point)
            if free is not None:
                joining[point] = entered[point] = free
                self._enter_point(point, free)
        self._refused_links.update(pair for r in self._refusals for pair in _both_ways(r.link))
        for link, apart in self._refusals:
            one, other = (self.survivors.find(self.joined[cell]) for cell in link[:2])
            self._refuse(offset, newcomer, (one, other), link[2:], apart, deltas)
        for point in sorted(entered):
            self._obey_joins(offset, newcomer, point, entered[point], deltas)
        return joining

    def _cluster(
        self, offset: Offset, newcomer: int, fresh: list[int], deltas: list[Delta]
    ) -> dict[int, PlaceOrdinal]:
        joining = super()._cluster(offset, newcomer, fresh, deltas)
        anchors = [point for point in joining if self._is_anchor(point)]
        for point in anchors:
            if not self.core_index.is_core(point):
                del joining[point]
                self._undecided.append(point)
        return joining

    def _earliest_in_reach(self, point: int) -> PlaceOrdinal | None:
        if not self._is_anchor(point):
            return super()._earliest_in_reach(point)
        self._undecided.append(point)
        return None

    def _merge(
        self,
        offset: Offset,
        newcomer: int,
        survivor: PlaceOrdinal,
        touched: dict[PlaceOrdinal, tuple[int, int]],
    ) -> PlacesMerged:
        delta = super()._merge(offset, newcomer, survivor, touched)
        self._refused_links.clear()
        self._anchors.merge(survivor, delta.absorbed)
        return delta

    def _parts(self, newcomer: int, fresh: list[int]) -> Iterator[Part]:
        parts = list(super()._parts(newcomer, fresh))
        if self._has_conflict(fresh, parts):
            yield from self._split(fresh)
        elif len(parts) == 1:
            yield parts[0]
        else:  # lazily: each uses the merges of the one before
            yield from super()._parts(newcomer, fresh)

    def _has_conflict(self, fresh: list[int], parts: list[Part]) -> bool:
        """Whether any two places or anchors that the fresh core points touch are kept apart."""
        touched = {place for part in parts for place in part.touched}
        sides = [inside for place in touched if (inside := self._anchors.inside(place))]
        sides += [self._own(p) for p in fresh if self._is_new_anchor(p)]
        return any(self._anchors.are_apart(one, other) for one, other in combinations(sides, 2))

    def _split(self, fresh: list[int]) -> Iterator[Part]:
        """The parts that the cells of fresh core points make with what they touch (rule 9)."""
        ranks = self._fresh_cells(fresh)
        links = list(self._cell_links(fresh, ranks))
        for link in links:
            if link.near not in ranks:
                ranks[link.near] = 0, self.survivors.find(self.joined[link.near])
        forest = _Forest()
        for rank in ranks.values():
            inside = self._anchors.inside(PlaceOrdinal(rank[1])) if rank[0] == 0 else {}
            forest.inside[rank] = [inside, {}]
        for point in filter(self._is_new_anchor, fresh):
            inside, entering = forest.inside[ranks[self.core_index.first_core(point)]]
            for group, keyframe in self._own(point).items():
                if group not in inside:
                    entering.setdefault(group, keyframe)
        for link in sorted(links, key=lambda each: sorted((ranks[each.cell], ranks[each.near]))):
            one, other = forest.find(ranks[link.cell]), forest.find(ranks[link.near])
            if one != other:
                sides = product(forest.inside[one], forest.inside[other])
                found = [apart for side in sides if (apart := self._anchors.apart(*side))]
                if found:
                    self._refusals.append(RefusedLink(link, min(found)))
                else:
                    forest.unite(one, other)
        return self._parts_of(forest, ranks, links, fresh)

    def _fresh_cells(self, fresh: list[int]) -> dict[int, Rank]:
        """The ranks of the cells with fresh core points. In a fresh cell with points of a place, a
        point of that place is made the first core point."""
        cells: dict[int, list[int]] = {}
        for point in fresh:
            cells.setdefault(self.core_index.first_core(point), []).append(point)
        ranks: dict[int, Rank] = {}
        for first, points in cells.items():
            if first not in fresh:
                ranks[first] = 0, self.survivors.find(self.joined[first])
                continue
            placed = [(p, point) for point in points if (p := self.label(point)) is not None]
            if placed:
                place, point = min(placed)
                self.core_index.put_first(point)
                ranks[point] = 0, place
            else:
                ranks[first] = 1, points[0]
        return ranks

    def _cell_links(self, fresh: list[int], ranks: dict[int, Rank]) -> Iterator[CellLink]:
        """The links that fresh core points make between cells, one for each pair of cells."""
        index, seen = self.core_index, set[tuple[int, int]]()
        for core in fresh:
            own = index.first_core(core)
            for first, cell in index.cores_around(core):
                if first == own or (own, first) in seen:
                    continue
                if cell is None:
                    neighbour: int | None = first
                elif own in fresh or first in fresh:
                    neighbour = index.core_in_reach(cell, core)
                elif self.survivors.find(self.joined[first]) == ranks[own][1]:
                    index.mark_one_cluster(core, cell)
                    continue
                else:
                    neighbour = index.core_in_reach(cell, core)
                if neighbour is not None:
                    seen |= {(own, first), (first, own)}
                    yield CellLink(own, first, core, neighbour)

    def _parts_of(
        self, forest: "_Forest", ranks: dict[int, Rank], links: list[CellLink], fresh: list[int]
    ) -> Iterator[Part]:
        """The parts with fresh core points, by their earliest, each with the places in it."""
        parts: dict[Rank, Part] = {}
        for point in fresh:
            first = self.core_index.first_core(point)
            part = parts.setdefault(forest.find(ranks[first]), Part([], {}))
            part.cores.append(point)
            if first not in fresh:
                part.touched.setdefault(PlaceOrdinal(ranks[first][1]), (point, first))
        for cell, near, core, neighbour in links:
            root = forest.find(ranks[cell])
            if near not in fresh and root == forest.find(ranks[near]):
                pair = (neighbour, near) if neighbour in fresh else (core, neighbour)
                parts[root].touched.setdefault(PlaceOrdinal(ranks[near][1]), pair)
        return iter(parts.values())

    def _first_without_conflict(self, point: int) -> PlaceOrdinal | None:
        """The place that an anchor that is not core joins (rule 10); None for noise."""
        index, find = self.core_index, self.survivors.find
        places = {
            find(self.joined[first])
            for first, cell in index.cores_around(point)
            if cell is None or index.core_in_reach(cell, point) is not None
        }
        own, anchors = self._own(point), self._anchors
        free = (p for p in places if not anchors.are_apart(own, anchors.inside(p)))
        return min(free, default=None)

    def _obey_joins(
        self, offset: Offset, newcomer: int, point: int, entered: PlaceOrdinal, deltas: list[Delta]
    ) -> None:
        """Make the place that an anchor has entered one with those of its group (rule 11)."""
        for other, named in list(self._anchors.to_join(self.keyframes[point])):
            place = self.survivors.find(entered)
            if other == place or other in self.survivors.absorbed_by:
                continue
            pair = point, self.point_of(named)
            apart = self._anchors.apart(*map(self._anchors.inside, (place, other)))
            if apart is None:
                first, second = sorted((place, other))
                merged = self._merge(offset, newcomer, first, {first: pair, second: pair})
                deltas.append(msgspec.structs.replace(merged, joined=merged.absorbed))
            else:
                self._refuse(offset, newcomer, (place, other), pair, apart, deltas)

    def _refuse(
        self,
        offset: Offset,
        newcomer: int,
        places: tuple[PlaceOrdinal, PlaceOrdinal],
        pair: tuple[int, int],
        apart: Apart,
        deltas: list[Delta],
    ) -> None:
        """Report a link that is refused, unless its two places were reported before. ``pair`` and
        ``apart`` are in the order of ``places``."""
        if places[0] > places[1]:
            places, apart = (places[1], places[0]), (apart[1], apart[0])
        if self._anchors.refuses(*places):
            bridge, link = self.keyframes[newcomer], self._link(*pair)
            deltas.append(MergeRefused(offset, *places, bridge, link, apart))

    def _is_anchor(self, point: int) -> bool:
        return self.keyframes[point] in self._anchors

    def _is_new_anchor(self, point: int) -> bool:
        return self.keyframes[point] in self._anchors and self.joined[point] == NOISE

    def _own(self, point: int) -> Inside:
        """The anchors in a place that holds only this anchor."""
        return self._anchors.own(self.keyframes[point])

    def _enter_point(self, point: int, place: PlaceOrdinal) -> None:
        self._anchors.enter(self.survivors.find(place), self._own(point))


def _both_ways(link: CellLink) -> tuple[tuple[int, int], tuple[int, int]]:
    return (link.cell, link.near), (link.near, link.cell)


class _Forest:
    """The links so far, as union-find by rank; a root is the earliest member. ``inside`` are the
    anchors below each root: those of places, which may be many and are not copied, and those that
    enter them."""

    def __init__(self) -> None:
        self.inside: dict[Rank, list[Inside]] = {}
        self._parents: dict[Rank, Rank] = {}

    def find(self, rank: Rank) -> Rank:
        while rank in self._parents:
            rank = self._parents[rank]
        return rank

    def unite(self, one: Rank, other: Rank) -> None:
        """Unite two roots."""
        first, second = sorted((one, other))
        self._parents[second] = first
        self.inside[first] += self.inside[second]


def places_by(settings: Settings, groups: PairGroups[Keyframe]) -> Places | Rooms:
    """The reducer of places; ``groups`` are the keyframes that commands name."""
    if settings.places == "rooms":
        rooms = settings.rooms
        return Rooms(metres_to_um(rooms.cell_m), metres_to_um(rooms.drive_m), groups)
    core_index = CoreIndex(metres_to_um(settings.eps_m), settings.min_samples)
    return ConstrainedPlaces(core_index, groups) if groups.group_of else Places(core_index)
