"""The gap ledger: which keyframes of which run are missing. Pure; times are passed in.

The rules:

* Robots number their keyframes consecutively. A run lacks the ids between the lowest and the
  highest recorded one; what came before the lowest (the recorder started late) is unknown.
* A *hole* is a range of missing ids. It opens when an id beyond it is recorded; a late keyframe
  closes it, shortens it or splits it in two.
* A hole is *reported* as a gap, once, when it has been open for the settle time or when the
  recorder ends. Until then keyframes out of order and a publisher's resending may fill it, and
  nothing is written that would have to be taken back.
* The ``mapfold/loss`` event of a gap stays in the log when a late keyframe closes the gap. So the
  keyframes that are missing now are counted by the holes, not by the sum of the loss events.
* A keyframe recorded twice is no loss. It is counted as a duplicate.
* A publisher may announce its last keyframe. When that was the settle time ago, and the run's
  highest recorded keyframe is lower, the ids in between are a hole too. When the recorder ends,
  younger announcements are disregarded: the keyframes may still be on their way. So are those of a
  run without any recorded keyframe, because its beginning is unknown.

A recorder folds the ledger over the log from its start (or from a saved one) when it opens it, so a
hole between the lives of two recorders is found like any other.
"""

import heapq
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

from .model import RunId
from .system_events import Loss

Source = TypeVar("Source", bound=str)
"""The id of a consecutive numbering: a `RunId` for keyframes, or a Zenoh publisher for messages."""

DEFAULT_SETTLE_NS: Final = 5_000_000_000
"""Longer than a publisher waits before it resends, so that a resent keyframe is no reported gap."""


@dataclass(frozen=True, slots=True)
class Gap(Generic[Source]):
    """The keyframes ``first`` to ``last`` of ``run_id``, both included, are missing."""

    run_id: Source
    first: int
    last: int

    def __post_init__(self) -> None:
        if self.last < self.first:
            raise ValueError(f"gap of {self.run_id!r} ends at {self.last} before {self.first}")

    @property
    def count(self) -> int:
        """How many keyframes are missing."""
        return self.last - self.first + 1


def gap_of(loss: Loss) -> Gap[RunId] | None:
    """The gap that a loss event reports; None for a loss of another kind."""
    if loss.cause != "keyframe_gap" or loss.first is None or loss.last is None:
        return None
    return Gap(RunId(loss.publisher), loss.first, loss.last) if loss.first <= loss.last else None


@dataclass(slots=True, eq=False)
class _Hole(Generic[Source]):
    run_id: Source
    first: int
    last: int
    since_ns: int
    reported: bool = False
    closed: bool = False

    @property
    def count(self) -> int:
        return self.last - self.first + 1


@dataclass(slots=True)
class _Run(Generic[Source]):
    """The recorded keyframes of one run: ``first`` to ``last`` except ``holes``, in ascending
    order."""

    run_id: Source
    first: int
    last: int
    holes: list[_Hole[Source]] = field(default_factory=list)

    def holes_before(self, keyframe_id: int) -> int:
        """How many holes begin at or before ``keyframe_id``."""
        return bisect_right(self.holes, keyframe_id, key=lambda hole: hole.first)


class RunState(NamedTuple, Generic[Source]):
    """The state of one run: ``holes`` are (first, last, whether reported), in order."""

    run_id: Source
    first: int
    last: int
    holes: tuple[tuple[int, int, bool], ...]


def is_consistent(runs: Iterable[RunState[Source]], events: int) -> bool:
    """Whether a ledger of ``events`` events can have this state: between two holes there is a
    recorded keyframe, and each event is one keyframe or a loss with a recorded one on each side."""
    seen: set[Source] = set()
    recorded = 0
    for run_id, first, last, holes in runs:
        if run_id in seen or last < first:
            return False
        seen.add(run_id)
        recorded += last - first + 1
        before = first - 1
        for start, end, _ in holes:
            if not before + 1 < start <= end < last:
                return False
            recorded -= end - start + 1
            before = end
    return recorded <= 2 * events


class GapLedger(Generic[Source]):
    """Recorded and missing keyframes by run. Memory: a few words per run and hole."""

    def __init__(self, settle_ns: int = DEFAULT_SETTLE_NS) -> None:
        self._settle_ns = settle_ns
        self._runs: dict[Source, _Run[Source]] = {}
        # A heap of holes to report, oldest first: (since_ns, serial number, hole).
        self._unreported: list[tuple[int, int, _Hole[Source]]] = []
        self._pushed = 0
        # Announcements of publishers, oldest first: (when, run, last keyframe).
        self._announced: deque[tuple[int, Source, int]] = deque()
        self.missing = 0
        """How many keyframes are missing now."""
        self.duplicates = 0
        """Keyframes recorded more than once."""

    def record(self, run_id: Source, keyframe_id: int, now_ns: int) -> None:
        """Add a recorded keyframe. ``now_ns`` is the opening time of a hole that it opens."""
        run = self._runs.get(run_id)
        if run is None:
            self._runs[run_id] = _Run(run_id, keyframe_id, keyframe_id)
        elif keyframe_id == run.last + 1:
            run.last = keyframe_id
        elif keyframe_id > run.last:
            self._add_new(run, len(run.holes), run.last + 1, keyframe_id - 1, now_ns)
            run.last = keyframe_id
        elif keyframe_id < run.first:
            if keyframe_id + 1 < run.first:
                self._add_new(run, 0, keyframe_id + 1, run.first - 1, now_ns)
            run.first = keyframe_id
        else:
            self._fill(run, keyframe_id)

    def has(self, run_id: Source, keyframe_id: int) -> bool:
        """Whether a keyframe is recorded."""
        run = self._runs.get(run_id)
        if run is None or not run.first <= keyframe_id <= run.last:
            return False
        index = run.holes_before(keyframe_id) - 1
        return index < 0 or keyframe_id > run.holes[index].last

    def expect(self, run_id: Source, last: int, now_ns: int) -> None:
        """Add a publisher's announcement, received at ``now_ns``, that it has sent keyframe
        ``last``."""
        self._announced.append((now_ns, run_id, last))

    def mark_reported(self, gap: Gap[Source]) -> None:
        """Mark the holes inside ``gap`` as reported, so that they are not reported again."""
        run = self._runs.get(gap.run_id)
        if run is None:
            return
        index = max(0, run.holes_before(gap.first) - 1)
        while index < len(run.holes) and run.holes[index].first <= gap.last:
            hole = run.holes[index]
            first, last = max(hole.first, gap.first), min(hole.last, gap.last)
            if first <= last and not hole.reported:
                self._split(run, index, first, last)
                index = run.holes_before(first) - 1
                run.holes[index].reported = True
            index += 1

    def add_reported(self, gap: Gap[Source], now_ns: int) -> None:
        """Add the gap of a loss event, as missing and reported. The keyframe before it counts as
        recorded if it is outside the run's known range."""
        before = gap.first - 1
        run = self._runs.get(gap.run_id)
        if run is None or not run.first <= before <= run.last:
            self.record(gap.run_id, before, now_ns)
        self._extend(gap.run_id, gap.last, now_ns)
        self.mark_reported(gap)

    def due(self, now_ns: int) -> list[Gap[Source]]:
        """The gaps that have been open for the settle time at ``now_ns``. Each is returned once."""
        settled_ns = now_ns - self._settle_ns
        while self._announced and self._announced[0][0] <= settled_ns:
            announced_ns, run_id, last = self._announced.popleft()
            self._extend(run_id, last, announced_ns)
        return self._report(settled_ns)

    def flush(self) -> list[Gap[Source]]:
        """Every gap not yet reported, however short it was open; for the end of a recording."""
        self._announced.clear()
        return self._report(None)

    def highest(self, run_id: Source) -> int | None:
        """The highest keyframe of a run, recorded or missing; None for an unknown run."""
        run = self._runs.get(run_id)
        return None if run is None else run.last

    def close(self, gap: Gap[Source]) -> None:
        """Count the missing keyframes of ``gap`` as recorded."""
        run = self._runs.get(gap.run_id)
        index = run.holes_before(gap.first - 1) if run is not None else 0
        while run is not None and index < len(run.holes) and run.holes[index].last <= gap.last:
            self._remove(run, index)

    def forget(self, run_id: Source) -> list[Gap[Source]]:
        """Drop a run; return its gaps that were not reported yet."""
        run = self._runs.pop(run_id)
        gaps = [Gap(run_id, hole.first, hole.last) for hole in run.holes if not hole.reported]
        while run.holes:
            self._remove(run, 0)
        return gaps

    def gaps(self) -> Iterator[Gap[Source]]:
        """All gaps, reported or not, in the order of each run's first keyframe."""
        for run in self._runs.values():
            for hole in run.holes:
                yield Gap(run.run_id, hole.first, hole.last)

    def reported_gaps(self) -> Iterator[Gap[Source]]:
        """The reported gaps that are still open, in the order of each run's first keyframe."""
        for run in self._runs.values():
            for hole in run.holes:
                if hole.reported:
                    yield Gap(run.run_id, hole.first, hole.last)

    def missing_reported(self) -> int:
        """How many of the missing keyframes have been reported."""
        return sum(gap.count for gap in self.reported_gaps())

    def state(self) -> tuple[RunState[Source], ...]:
        """The state for `restore`; it does not have the opening times of holes."""
        return tuple(
            RunState(
                run.run_id,
                run.first,
                run.last,
                tuple((hole.first, hole.last, hole.reported) for hole in run.holes),
            )
            for run in self._runs.values()
        )

    def restore(self, runs: Iterable[RunState[Source]], now_ns: int) -> None:
        """Fill a new ledger; unreported holes count as open since ``now_ns``."""
        for saved in runs:
            run = self._runs[saved.run_id] = _Run(saved.run_id, saved.first, saved.last)
            for first, last, reported in saved.holes:
                self._add(run, len(run.holes), _Hole(run.run_id, first, last, now_ns, reported))

    def _add_new(self, run: _Run[Source], index: int, first: int, last: int, now_ns: int) -> None:
        self._add(run, index, _Hole(run.run_id, first, last, now_ns))

    def _add(self, run: _Run[Source], index: int, hole: _Hole[Source]) -> None:
        run.holes.insert(index, hole)
        self.missing += hole.count
        if not hole.reported:
            self._pushed += 1
            heapq.heappush(self._unreported, (hole.since_ns, self._pushed, hole))

    def _fill(self, run: _Run[Source], keyframe_id: int) -> None:
        index = run.holes_before(keyframe_id) - 1
        if index < 0 or keyframe_id > run.holes[index].last:
            self.duplicates += 1
            return
        self._split(run, index, keyframe_id, keyframe_id)
        self._remove(run, run.holes_before(keyframe_id) - 1)

    def _extend(self, run_id: Source, last: int, now_ns: int) -> None:
        """Open a hole from behind the run's last keyframe up to ``last``; none if ``last`` is not
        beyond it."""
        run = self._runs.get(run_id)
        if run is not None and last > run.last:
            self._add_new(run, len(run.holes), run.last + 1, last, now_ns)
            run.last = last

    def _split(self, run: _Run[Source], index: int, first: int, last: int) -> None:
        """Split a hole so that ``first`` to ``last`` is a hole of its own."""
        hole = run.holes[index]
        if (hole.first, hole.last) == (first, last):
            return
        self._remove(run, index)
        for start, end in ((last + 1, hole.last), (first, last), (hole.first, first - 1)):
            if start <= end:
                self._add(run, index, _Hole(run.run_id, start, end, hole.since_ns, hole.reported))

    def _remove(self, run: _Run[Source], index: int) -> None:
        hole = run.holes.pop(index)
        hole.closed = True
        self.missing -= hole.count

    def _report(self, open_since_ns: int | None) -> list[Gap[Source]]:
        """The unreported holes open since ``open_since_ns`` or before (None: all), marked as
        reported. Sorted by run id and keyframe, so that equal ledgers report equally."""
        reported = []
        while self._unreported and (
            open_since_ns is None or self._unreported[0][0] <= open_since_ns
        ):
            hole = heapq.heappop(self._unreported)[2]
            if not (hole.reported or hole.closed):
                hole.reported = True
                reported.append(Gap(hole.run_id, hole.first, hole.last))
        return sorted(reported, key=lambda gap: (gap.run_id, gap.first))
