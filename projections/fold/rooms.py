"""Places by rooms (``places = "rooms"``): clusters by the mean distance driven between cells.

The rules (docs/places.md lists the alternatives):

1.  A keyframe belongs to a *cell*, the area around the first pose there, and a cell to a place
    (`projections.fold.driven_cells`). So every keyframe with a pose has a place on arrival.
2.  The *mean drive* of two places is the mean driven distance between the cells of one and those of
    the other; pairs of cells that are twice ``drive_um`` or more apart count as that far.
3.  A new cell joins the place with the least mean drive to it, if that is ``drive_um`` or less; of
    several the one founded first. Else its keyframe founds a place, in which it is the first.
4.  Then, while two places have a mean drive of ``drive_um`` or less, the two with the least become
    one (of several, those founded first). A new way between two cells brings places closer; so
    does a new cell in one of them.
5.  Places with anchors that are kept apart are never made one, a `MergeRefused` once for each two.
    An anchor in the cell of a place with which it is kept apart has a cell of its own.
6.  Places with anchors that are joined become one as soon as both have come, unless they conflict.

A mean is never computed: a pair of cells at distance d is (2·drive - d) *close*, and the mean drive
of two places is ``drive_um`` or less when their cells' closeness adds up to ``drive_um`` for each
pair of cells or more. These sums are integers, kept for places within reach, and changed only by
the pairs that come nearer.

A place has a bounded number of cells: at least half of them are within reach of the cell that it
takes in. So the cost of a keyframe is bounded by the number of cells near it.
"""

from collections.abc import Iterable
from typing import NamedTuple

from eventsrc.envelope.model import Offset

from . import State, part, prefixed
from .corrections import Keyframe
from .deltas import (
    Delta,
    KeyframeOrdinal,
    KeyframePlaced,
    MeanDrive,
    MergeRefused,
    PlaceLink,
    PlaceOrdinal,
    PlacesMerged,
    RunOrdinal,
)
from .driven_cells import DrivenCells, WayAt
from .exact import distance_um
from .pair_groups import ApartPairs, PairGroups
from .place_members import Apart, PlaceAnchors, PlaceMembers, PosedKeyframe

_NO_GROUPS: PairGroups[Keyframe] = PairGroups((), ApartPairs())


class Pair(NamedTuple):
    """Two places, the one founded first first."""

    a: PlaceOrdinal
    b: PlaceOrdinal


class Rooms(PlaceMembers):
    """The reducer of places by rooms. `add_anchor` precedes `fold` of the anchor's keyframe."""

    def __init__(
        self,
        cell_um: int,
        drive_um: int,
        groups: PairGroups[Keyframe] = _NO_GROUPS,
        way_at: WayAt | None = None,
    ) -> None:
        super().__init__()
        self._drive_um = drive_um
        self._cells = DrivenCells(cell_um, 2 * drive_um, way_at)
        self._anchors = PlaceAnchors(groups)
        # Per cell: the place it joined, as of then, and the point that founded it.
        self._cell_places: list[PlaceOrdinal] = []
        self._founders: list[int] = []
        # Per place: its cells, and by place within reach the closeness of their cells.
        self._own_cells: list[list[int]] = []
        self._closeness: list[dict[PlaceOrdinal, int]] = []
        self._last_cells: dict[RunOrdinal, int] = {}
        # The positions of anchors, for the distance of two that a command joins.
        self._positions: dict[KeyframeOrdinal, tuple[int, int]] = {}

    def add_anchor(self, keyframe: KeyframeOrdinal, anchor: Keyframe) -> None:
        """Register a keyframe as an anchor, if it is one."""
        self._anchors.add(keyframe, anchor)

    def use_walls(self, way_at: WayAt | None) -> None:
        """Use these walls for cells and links from now on; existing ones stay."""
        self._cells.way_at = way_at

    def fold(self, posed: PosedKeyframe) -> list[Delta]:
        """Add a keyframe with a pose; returns the deltas in the order of `fold.deltas`."""
        offset, keyframe, run, run_id, x_um, y_um = posed
        point = self.add_point(keyframe, run, run_id)
        cell, last = self._cells.find(x_um, y_um), self._last_cells.get(run)
        is_anchor = keyframe in self._anchors
        if cell is not None and (not is_anchor or self._may_enter(keyframe, cell)):
            deltas = list[Delta]()
            if is_anchor:  # the anchors of its place affect the merges that follow
                self._anchors.enter(self._place_of_cell(cell), self._anchors.own(keyframe))
            if last is not None and not self._cells.is_linked(last, cell):
                deltas = self._merge_all(offset, keyframe, self._link(last, cell))
            elif not is_anchor:  # nearly always
                self._last_cells[run] = cell
                place = self._place_of_cell(cell)
                self.join_place(point, place, x_um, y_um)
                return [KeyframePlaced(offset, keyframe, place), self.place_changed(offset, place)]
        else:
            cell = self._cells.add(x_um, y_um)
            deltas = self._give_place(offset, point, cell, last)
        self._last_cells[run] = cell
        place = self._place_of_cell(cell)
        if is_anchor:
            place = self._enter(offset, keyframe, place, (x_um, y_um), deltas)
        self.join_place(point, place, x_um, y_um)
        changed = {place, *(d.survivor for d in deltas if type(d) is PlacesMerged)}
        deltas.append(KeyframePlaced(offset, keyframe, place))
        find = self.survivors.find
        deltas += [self.place_changed(offset, each) for each in sorted({*map(find, changed)})]
        return deltas

    def dump(self) -> State:
        """The whole state, to be kept."""
        own = {
            "cell_places": list(self._cell_places),
            "cell_founders": list(self._founders),
            "last_cells": [[run, cell] for run, cell in self._last_cells.items()],
            "positions": [[keyframe, *at] for keyframe, at in self._positions.items()],
        }
        parts = prefixed("cells", self._cells.dump()) | prefixed("anchors", self._anchors.dump())
        return super().dump() | own | parts

    def load(self, state: State) -> None:
        """Restore the state of `dump`. Closeness is added up again."""
        super().load(state)
        self._cells.load(part("cells", state))
        self._anchors.load(part("anchors", state), self.place_of)
        self._cell_places = state["cell_places"]
        self._founders = state["cell_founders"]
        self._last_cells = dict(state["last_cells"])
        self._positions = {keyframe: (x, y) for keyframe, x, y in state["positions"]}
        self._own_cells = [[] for _ in self.member_counts]
        self._closeness = [{} for _ in self.member_counts]
        for cell in range(len(self._cell_places)):
            self._own_cells[self._place_of_cell(cell)].append(cell)
            for other, distance in self._cells.near[cell].items():
                if other < cell:
                    self._come_closer(cell, other, self._cells.reach_um - distance)

    def _may_enter(self, anchor: KeyframeOrdinal, cell: int) -> bool:
        """Whether nothing in the cell's place is kept apart from the anchor."""
        inside = self._anchors.inside(self._place_of_cell(cell))
        return not self._anchors.are_apart(self._anchors.own(anchor), inside)

    def _place_of_cell(self, cell: int) -> PlaceOrdinal:
        return self.survivors.find(self._cell_places[cell])

    def _link(self, a: int, b: int) -> set[Pair]:
        """Link two cells of places; returns the pairs of places that come closer."""
        closer = set[Pair]()
        for one, other, before_um, distance in self._cells.link(a, b):
            pair = self._come_closer(one, other, before_um - distance)
            if pair is not None:
                closer.add(pair)
        return closer

    def _come_closer(self, one: int, other: int, by_um: int) -> Pair | None:
        """Add to the closeness of two cells' places; returns the pair if there are two places."""
        a, b = self._place_of_cell(one), self._place_of_cell(other)
        if a == b:
            return None
        self._closeness[a][b] = self._closeness[a].get(b, 0) + by_um
        self._closeness[b][a] = self._closeness[a][b]
        return Pair(min(a, b), max(a, b))

    def _give_place(self, offset: Offset, founder: int, cell: int, last: int | None) -> list[Delta]:
        """Give a new cell its place (rule 3), and merge places that come closer by it."""
        closer = set[Pair]()
        around = self._cells.with_a_way_to(cell)
        for other in around if last is None else (last, *around):
            if not self._cells.is_linked(other, cell):
                for one, another, before_um, distance in self._cells.link(other, cell):
                    if cell not in (one, another):
                        pair = self._come_closer(one, another, before_um - distance)
                        closer |= set() if pair is None else {pair}
        reach, sums = self._cells.reach_um, dict[PlaceOrdinal, int]()
        for other, distance in self._cells.near[cell].items():
            place = self._place_of_cell(other)
            sums[place] = sums.get(place, 0) + reach - distance
        deltas = list[Delta]()
        own = self._anchors.own(self.keyframes[founder])
        joined = self._closest(sums, own)
        if joined is None:
            formed = self.form_place(offset, founder)
            deltas.append(formed)
            joined = formed.place
            self._own_cells.append([])
            self._closeness.append({})
        self._cell_places.append(joined)
        self._founders.append(founder)
        self._own_cells[joined].append(cell)
        if own:
            self._anchors.enter(joined, own)
        for place, closeness in sums.items():
            if place != joined:
                self._closeness[joined][place] = self._closeness[joined].get(place, 0) + closeness
                self._closeness[place][joined] = self._closeness[joined][place]
        closer |= self._pairs_of(joined)
        return deltas + self._merge_all(offset, self.keyframes[founder], closer)

    def _closest(
        self, sums: dict[PlaceOrdinal, int], own: dict[int, KeyframeOrdinal]
    ) -> PlaceOrdinal | None:
        """The place that a new cell joins, by its closeness to each; None if it founds one."""
        best, most, pairs = None, 0, 1
        for place in sorted(sums):
            closeness, cells = sums[place], len(self._own_cells[place])
            if closeness < self._drive_um * cells or closeness * pairs <= most * cells:
                continue
            if own and self._anchors.are_apart(own, self._anchors.inside(place)):
                continue
            best, most, pairs = place, closeness, cells
        return best

    def _merge_all(self, offset: Offset, bridge: KeyframeOrdinal, closer: set[Pair]) -> list[Delta]:
        """Merge places while any are close enough (rule 4); ``closer`` are those that may be."""
        deltas = list[Delta]()
        while closer:
            best, most, pairs, refused = None, 0, 1, list[tuple[Pair, Apart]]()
            for pair in sorted(closer):
                closeness, number = self._closeness[pair.a].get(pair.b, 0), self._cell_pairs(pair)
                if closeness < self._drive_um * number:
                    continue
                inside = self._anchors.inside(pair.a), self._anchors.inside(pair.b)
                apart = self._anchors.apart(*inside)
                if apart is not None:
                    refused.append((pair, apart))
                elif closeness * pairs > most * number:
                    best, most, pairs = pair, closeness, number
            if best is None:
                for pair, apart in refused:
                    if self._anchors.refuses(*pair):
                        link = self._link_of(pair)
                        deltas.append(MergeRefused(offset, *pair, bridge, link, apart))
                break
            drive = MeanDrive(
                (self._cells.reach_um * pairs - most) // pairs, *map(self._size, best)
            )
            deltas.append(self._merge(offset, bridge, best, self._link_of(best), drive))
            closer = self._of_survivors(closer) | self._pairs_of(best.a)
        return deltas

    def _cell_pairs(self, pair: Pair) -> int:
        return self._size(pair.a) * self._size(pair.b)

    def _size(self, place: PlaceOrdinal) -> int:
        """How many cells a place has."""
        return len(self._own_cells[place])

    def _pairs_of(self, place: PlaceOrdinal) -> set[Pair]:
        """The pairs of a place and each place within reach."""
        return {Pair(min(place, other), max(place, other)) for other in self._closeness[place]}

    def _of_survivors(self, pairs: Iterable[Pair]) -> set[Pair]:
        """The pairs of the survivors of these places."""
        find = self.survivors.find
        both = ((find(a), find(b)) for a, b in pairs)
        return {Pair(min(each), max(each)) for each in both if each[0] != each[1]}

    def _merge(
        self,
        offset: Offset,
        bridge: KeyframeOrdinal,
        pair: Pair,
        link: PlaceLink,
        drive: MeanDrive | None,
    ) -> PlacesMerged:
        """Merge a pair; ``drive`` is None if a command joins them."""
        survivor, absorbed = pair
        counts = self.member_counts
        delta = PlacesMerged(
            offset,
            survivor,
            (absorbed,),
            bridge,
            links=(link,),
            survivor_count=counts[survivor],
            absorbed_counts=(counts[absorbed],),
            joined=(absorbed,) if drive is None else (),
            drives=() if drive is None else (drive,),
        )
        self.absorb(survivor, (absorbed,))
        self._anchors.merge(survivor, (absorbed,))
        self._own_cells[survivor] += self._own_cells[absorbed]
        self._own_cells[absorbed] = []
        for place, closeness in self._closeness[absorbed].items():
            del self._closeness[place][absorbed]
            if place != survivor:
                own = self._closeness[survivor]
                own[place] = self._closeness[place][survivor] = own.get(place, 0) + closeness
        self._closeness[absorbed] = {}
        return delta

    def _link_of(self, pair: Pair) -> PlaceLink:
        """The founders of the two places' cells that are the shortest drive apart, and how far that
        is; of several the earliest. Places that merge always have some within reach."""
        distance, cell, other = min(
            (distance, cell, other)
            for cell in self._own_cells[pair.a]
            for other, distance in self._cells.near[cell].items()
            if self._place_of_cell(other) == pair.b
        )
        core, neighbour = (self.keyframes[self._founders[each]] for each in (cell, other))
        return PlaceLink(core, neighbour, distance)

    def _enter(
        self,
        offset: Offset,
        anchor: KeyframeOrdinal,
        place: PlaceOrdinal,
        position: tuple[int, int],
        deltas: list[Delta],
    ) -> PlaceOrdinal:
        """An anchor is in a place; obey the commands that join it to others (rule 6)."""
        self._positions[anchor] = position
        self._anchors.enter(place, self._anchors.own(anchor))
        for other, named in list(self._anchors.to_join(anchor)):
            place = self.survivors.find(place)
            if other == place or other in self.survivors.absorbed_by:
                continue
            pair = Pair(min(place, other), max(place, other))
            ends = (anchor, named) if place < other else (named, anchor)
            (ax, ay), (bx, by) = map(self._positions.__getitem__, ends)
            link = PlaceLink(*ends, distance_um(ax, ay, bx, by))
            apart = self._anchors.apart(*map(self._anchors.inside, pair))
            if apart is None:
                deltas.append(self._merge(offset, anchor, pair, link, None))
                deltas += self._merge_all(offset, anchor, self._pairs_of(pair.a))
            elif self._anchors.refuses(*pair):
                deltas.append(MergeRefused(offset, *pair, anchor, link, apart))
        return self.survivors.find(place)
