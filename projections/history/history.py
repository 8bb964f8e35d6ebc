"""The history of a map: one fold over the deltas that remembers instead of forgetting.

It is fed the deltas of each event, in order, and keeps for every place and object what happened to
it and because of which event. `merges`, `why`, `bisect` and a map at any offset are read from it
without folding again. It holds no embeddings. Which place a keyframe is in is found through the
chain of absorptions (`place_at`), so a merge costs nothing per member.

An ``end`` is a number of events: what is told is the map after the events 0 … end − 1.

Who was near a keyframe at any moment: what a merge is explained and drawn with.

Counts as the fold's own rule does, exactly and from the poses alone: a keyframe is a core point
when at least ``min_samples`` posed keyframes, itself included, are within ε of it, inclusive.
"""

from array import array
from bisect import bisect_left
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope import FIRST_OFFSET, KeyframeId, Offset, RunId
from projections.deltas import (
    Delta,
    EventSkipped,
    KeyframeAdded,
    KeyframeOrdinal,
    KeyframePlaced,
    ObjectFound,
    ObjectMoved,
    ObjectOrdinal,
    ObjectSeen,
    PlaceChanged,
    PlaceFormed,
    PlaceOrdinal,
    PlacesLinked,
    PlacesMerged,
    RunSeen,
)
from projections.exact import distance_um, metres_to_um
from projections.reducers import packed
from projections.settings import Settings

from .records import Cause, EdgeChange, Merge, ObjectLife, PlaceLife, cause_of, last_before


class Neighbours:
    """The poses of keyframes in a grid of ε, for asking who is within ε of whom."""

    def __init__(self, keyframes: Sequence[KeyframeAdded], settings: Settings) -> None:
        self._radius = metres_to_um(settings.eps_m)
        self._min_samples = settings.min_samples
        posed = [(k.keyframe, k.offset, k.pose) for k in keyframes if k.pose is not None]
        self._numbers = [n for n, _, _ in posed]
        self._offsets = [offset for _, offset, _ in posed]
        self._spots = np.array([(p.x_um, p.y_um) for _, _, p in posed], np.int64).reshape(-1, 2)
        self._row = {number: row for row, number in enumerate(self._numbers)}
        self._cells = _rows_by_cell(self._spots // self._radius)

    def of(self, keyframe: KeyframeOrdinal, end: Offset) -> list[KeyframeOrdinal]:
        """Keyframes within ε of a posed ``keyframe``, itself too, after ``end`` events; ascending
        ordinals."""
        x, y = self._spots[self._row[keyframe]]
        column, row = int(x) // self._radius, int(y) // self._radius
        around = [(column + i, row + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        rows = np.concatenate([self._cells[cell] for cell in around if cell in self._cells])
        rows = np.sort(rows[rows < bisect_left(self._offsets, end)])
        # In these cells a difference is at most 2·10⁹ µm, so its square fits int64.
        near = ((self._spots[rows] - (x, y)) ** 2).sum(axis=1) <= self._radius**2
        return [self._numbers[row] for row in rows[near]]

    def is_core(self, keyframe: KeyframeOrdinal, end: Offset) -> bool:
        """Whether it is a core point after ``end`` events; false before it came."""
        row = self._row.get(keyframe)
        if row is None or self._offsets[row] >= end:
            return False
        return len(self.of(keyframe, end)) >= self._min_samples

    def made_core(self, bridge: KeyframeOrdinal, offset: Offset) -> list[KeyframeOrdinal]:
        """The keyframes that the coming of ``bridge`` at ``offset`` made core points."""
        if bridge not in self._row:
            return []
        return [
            keyframe
            for keyframe in self.of(bridge, Offset(offset + 1))
            if self.is_core(keyframe, Offset(offset + 1)) and not self.is_core(keyframe, offset)
        ]

    def distance_um(self, a: KeyframeOrdinal, b: KeyframeOrdinal) -> int:
        """The distance of two posed keyframes, rounded down."""
        (ax, ay), (bx, by) = (map(int, self._spots[self._row[k]]) for k in (a, b))
        return distance_um(ax, ay, bx, by)

    def spots(self, keyframes: Sequence[KeyframeOrdinal]) -> NDArray[np.float64]:
        """Positions of posed keyframes in metres, shape (n, 2)."""
        metres: NDArray[np.float64] = self._spots[[self._row[k] for k in keyframes]] / 1e6
        return metres


def _rows_by_cell(cells: NDArray[np.int64]) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Which rows of ``cells``, shape (n, 2), hold which cell; ascending rows."""
    if not len(cells):
        return {}
    order = np.lexsort((cells[:, 1], cells[:, 0]))  # stable, so rows stay ascending
    found = cells[order]
    starts = np.flatnonzero((found[1:] != found[:-1]).any(axis=1)) + 1
    firsts = found[np.concatenate(([0], starts))]
    keys = [(column, row) for column, row in firsts.tolist()]
    return dict(zip(keys, np.split(order, starts), strict=True))


NEVER = Offset(2**63 - 1)
"""The offset of what has not happened."""
NO_PLACE = PlaceOrdinal(-1)
"""What `History.placed_in` holds for a keyframe in no place."""


@dataclass(frozen=True, slots=True)
class _Move:
    object: ObjectOrdinal
    before: PlaceOrdinal | None


class History:
    """Everything that happened to places and objects in the events applied so far.

    ``keyframe_offsets`` gives each keyframe's event, ``placed_offsets`` and ``placed_in`` the event
    that placed it (`NEVER` for noise) and the place it joined then; all by keyframe ordinal.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.next_offset = FIRST_OFFSET
        self.keyframes: list[KeyframeAdded] = []
        self.keyframe_offsets = array("q")
        self.placed_offsets = array("q")
        self.placed_in: MutableSequence[PlaceOrdinal] = packed("q")
        self.places: list[PlaceLife] = []
        self.objects: list[ObjectLife] = []
        self.merges: list[Merge] = []
        self.runs: list[list[RunSeen]] = []
        self.skipped: list[EventSkipped] = []
        self.edges: dict[tuple[PlaceOrdinal, PlaceOrdinal], list[PlacesLinked]] = {}
        self.keyframe_numbers: dict[tuple[RunId, KeyframeId], KeyframeOrdinal] = {}
        self.place_numbers: dict[str, PlaceOrdinal] = {}
        self.object_numbers: dict[str, ObjectOrdinal] = {}
        self._neighbours: tuple[int, Neighbours] | None = None

    def apply(self, offset: Offset, deltas: Sequence[Delta]) -> None:
        """Remember what the event at ``offset`` did."""
        self.next_offset = Offset(offset + 1)
        if not deltas:
            return
        cause = cause_of(offset, deltas)
        merges: list[PlacesMerged] = []
        moves: list[_Move] = []
        links: list[EdgeChange] = []
        for delta in deltas:
            if (handle := self._APPLIERS.get(type(delta))) is not None:
                handle(self, delta, cause)
            elif isinstance(delta, PlacesMerged):
                merges.append(delta)
            elif isinstance(delta, ObjectMoved):
                moves.append(self._object_moved(delta))
            elif isinstance(delta, PlacesLinked):
                links.append(self._places_linked(delta))
        for merge in merges:
            self._places_merged(merge, cause, moves, links)

    @property
    def neighbours(self) -> Neighbours:
        """Who is near whom, among the keyframes so far."""
        count = len(self.keyframes)
        if self._neighbours is None or self._neighbours[0] != count:
            self._neighbours = count, Neighbours(self.keyframes, self.settings)
        return self._neighbours[1]

    def place_at(self, keyframe: KeyframeOrdinal, end: Offset | None = None) -> PlaceOrdinal | None:
        """The place a keyframe is in after the events below ``end`` (default: all so far)."""
        end = self.next_offset if end is None else end
        if self.placed_offsets[keyframe] >= end:
            return None
        return self.survivor_of(self.placed_in[keyframe], end)

    def survivor_of(self, place: PlaceOrdinal, end: Offset | None = None) -> PlaceOrdinal:
        """Who stands for ``place`` after the events below ``end`` (default: all so far)."""
        end = self.next_offset if end is None else end
        while (merge := self.places[place].absorbed) is not None and merge.cause.offset < end:
            place = merge.survivor
        return place

    def keyframe_count(self, end: Offset) -> int:
        """Keyframes added by the events below ``end``."""
        return bisect_left(self.keyframe_offsets, end)

    def cause_at(self, offset: Offset) -> Cause:
        """The cause of what the event at ``offset`` did."""
        number = bisect_left(self.keyframe_offsets, offset)
        added = self.keyframes[number : number + 1]
        return cause_of(offset, [k for k in added if k.offset == offset])

    def transitions(self, a: PlaceOrdinal, b: PlaceOrdinal, end: Offset) -> int:
        """Shared transitions of two places after the events below ``end``."""
        pair = (min(a, b), max(a, b))
        linked = last_before(self.edges.get(pair, ()), end)
        return 0 if linked is None else linked.shared_transitions

    def _run_seen(self, delta: RunSeen, _: Cause) -> None:
        if delta.run == len(self.runs):
            self.runs.append([])
        self.runs[delta.run].append(delta)

    def _keyframe_added(self, delta: KeyframeAdded, _: Cause) -> None:
        self.keyframe_numbers[delta.run_id, delta.keyframe_id] = delta.keyframe
        self.keyframes.append(delta)
        self.keyframe_offsets.append(delta.offset)
        self.placed_offsets.append(NEVER)
        self.placed_in.append(NO_PLACE)

    def _event_skipped(self, delta: EventSkipped, _: Cause) -> None:
        self.skipped.append(delta)

    def _place_formed(self, delta: PlaceFormed, cause: Cause) -> None:
        self.place_numbers[delta.place_id] = delta.place
        self.places.append(PlaceLife(delta, cause))

    def _keyframe_placed(self, delta: KeyframePlaced, _: Cause) -> None:
        self.placed_offsets[delta.keyframe] = delta.offset
        self.placed_in[delta.keyframe] = delta.place
        self.places[delta.place].joined.append(delta)

    def _place_changed(self, delta: PlaceChanged, _: Cause) -> None:
        self.places[delta.place].changes.append(delta)

    def _object_found(self, delta: ObjectFound, cause: Cause) -> None:
        self.object_numbers[delta.object_id] = delta.object
        self.objects.append(ObjectLife(delta, cause))

    def _object_seen(self, delta: ObjectSeen, _: Cause) -> None:
        self.objects[delta.object].seen.append(delta)

    # Of the class, not bound to the history; `MapView` says why.
    _APPLIERS: ClassVar[dict[type, Callable[["History", Any, Cause], None]]] = {
        RunSeen: _run_seen,
        KeyframeAdded: _keyframe_added,
        EventSkipped: _event_skipped,
        PlaceFormed: _place_formed,
        KeyframePlaced: _keyframe_placed,
        PlaceChanged: _place_changed,
        ObjectFound: _object_found,
        ObjectSeen: _object_seen,
    }

    def _object_moved(self, delta: ObjectMoved) -> _Move:
        life = self.objects[delta.object]
        move = _Move(delta.object, life.located[-1].place if life.located else None)
        life.located.append(delta)
        return move

    def _places_linked(self, delta: PlacesLinked) -> EdgeChange:
        linked = self.edges.setdefault((delta.a, delta.b), [])
        before = linked[-1].shared_transitions if linked else 0
        linked.append(delta)
        return EdgeChange(delta.a, delta.b, before, delta.shared_transitions)

    def _places_merged(
        self, delta: PlacesMerged, cause: Cause, moves: list[_Move], links: list[EdgeChange]
    ) -> None:
        places = {delta.survivor, *delta.absorbed}
        merge = Merge(
            number=len(self.merges) + 1,
            cause=cause,
            bridge=delta.bridge,
            survivor=delta.survivor,
            survivor_size=delta.survivor_count,
            absorbed=delta.absorbed,
            absorbed_sizes=delta.absorbed_counts,
            links=delta.links,
            objects=tuple(move.object for move in moves if move.before in delta.absorbed),
            edges=tuple(link for link in links if link.a in places or link.b in places),
        )
        self.merges.append(merge)
        self.places[delta.survivor].merges.append(merge)
        for place in delta.absorbed:
            self.places[place].absorbed = merge
