"""The gap ledger: which keyframes of which run never came. Pure; times are given to it.

The rules:

* Robots count their keyframes by one. What a run lacks are the ids between the lowest and the
  highest that were recorded; what came before the lowest (a recorder started late) nobody can know.
* A *hole* is a stretch of missing ids. It opens when an id beyond it is recorded, and a late
  keyframe closes it: wholly, or by cutting it shorter or in two.
* A hole is *reported* as a gap, once, when it has been open for the settle time or when the
  recorder ends. Until then keyframes out of order and a publisher's resending may still fill it,
  and nothing is written that would have to be taken back.
* A log never forgets: the ``mapfold/loss`` event of a gap stays when a late keyframe closes it.
  So what is lost *now* is never the sum of the loss events, but the holes of the whole log.
* One keyframe twice is no loss. It is counted as a duplicate.
* A publisher may say how far it has got. When it said so the settle time ago, and the run's highest
  recorded keyframe is still a lower one, what lies behind that is a hole too. At a recorder's end
  a younger statement is disregarded: what it speaks of may still be on its way. So is one of a run
  of which nothing is recorded, because its beginning is unknown.

A ledger is folded over a log from its start (or from a saved one) when a recorder opens it, so a
hole between two recorders' lives is found like any other.
"""

import heapq
from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, NamedTuple, TypeVar

from .envelope import RunId
from .system_events import Loss

Source = TypeVar("Source", bound=str)
"""Who counts: a `RunId` of its keyframes, or a Zenoh publisher of its messages."""

DEFAULT_SETTLE_NS: Final = 5_000_000_000
"""Longer than a publisher waits before it sends again, so a resent keyframe is no reported gap."""


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
    """What is recorded of one run: ``first`` to ``last`` but for the holes, which are in order."""

    run_id: Source
    first: int
    last: int
    holes: list[_Hole[Source]] = field(default_factory=list)

    def holes_before(self, keyframe_id: int) -> int:
        """How many holes begin at or before ``keyframe_id``."""
        return bisect_right(self.holes, keyframe_id, key=lambda hole: hole.first)


class RunState(NamedTuple, Generic[Source]):
    """What a ledger knows of one run: ``holes`` are (first, last, whether reported), in order."""

    run_id: Source
    first: int
    last: int
    holes: tuple[tuple[int, int, bool], ...]


def sound(runs: Iterable[RunState[Source]], events: int) -> bool:
    """Whether a ledger of that many events can be in this state. Between two holes there is a
    recorded keyframe, and each event is one keyframe, or a loss with one recorded on each side."""
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
    """What is recorded and what is missing, run by run. Memory: a few words per run and hole."""

    def __init__(self, settle_ns: int = DEFAULT_SETTLE_NS) -> None:
        self._settle_ns = settle_ns
        self._runs: dict[Source, _Run[Source]] = {}
        # Holes to report, oldest first: (since_ns, a number that makes it unique, hole).
        self._young: list[tuple[int, int, _Hole[Source]]] = []
        self._opened = 0
        # What publishers said, oldest first: (when, run, its last keyframe).
        self._said: deque[tuple[int, Source, int]] = deque()
        self.missing = 0
        """How many keyframes are missing now."""
        self.duplicates = 0
        """Keyframes recorded more than once."""

    def record(self, run_id: Source, keyframe_id: int, now_ns: int) -> None:
        """Take in one recorded keyframe. ``now_ns`` is when a hole it opens began to be open."""
        run = self._runs.get(run_id)
        if run is None:
            self._runs[run_id] = _Run(run_id, keyframe_id, keyframe_id)
        elif keyframe_id == run.last + 1:
            run.last = keyframe_id
        elif keyframe_id > run.last:
            self._open(run, len(run.holes), run.last + 1, keyframe_id - 1, now_ns)
            run.last = keyframe_id
        elif keyframe_id < run.first:
            if keyframe_id + 1 < run.first:
                self._open(run, 0, keyframe_id + 1, run.first - 1, now_ns)
            run.first = keyframe_id
        else:
            self._fill(run, keyframe_id)

    def expect(self, run_id: Source, last: int, now_ns: int) -> None:
        """The publisher of ``run_id`` says at ``now_ns`` that it has sent keyframe ``last``."""
        self._said.append((now_ns, run_id, last))

    def mark_reported(self, gap: Gap[Source]) -> None:
        """The log says that ``gap`` was reported: what is left of it will not be reported again."""
        run = self._runs.get(gap.run_id)
        if run is None:
            return
        index = max(0, run.holes_before(gap.first) - 1)
        while index < len(run.holes) and run.holes[index].first <= gap.last:
            hole = run.holes[index]
            first, last = max(hole.first, gap.first), min(hole.last, gap.last)
            if first <= last and not hole.reported:
                self._cut(run, index, first, last)
                index = run.holes_before(first) - 1
                run.holes[index].reported = True
            index += 1

    def assume(self, gap: Gap[Source], now_ns: int) -> None:
        """Take a loss event's word for it: the keyframe before ``gap`` was recorded or reported
        missing, ``gap`` is missing, and it will not be reported again."""
        before = gap.first - 1
        run = self._runs.get(gap.run_id)
        if run is None or not run.first <= before <= run.last:
            self.record(gap.run_id, before, now_ns)
        self._extend(gap.run_id, gap.last, now_ns)
        self.mark_reported(gap)

    def due(self, now_ns: int) -> list[Gap[Source]]:
        """The gaps to report now: open for the settle time. Each is returned once."""
        settled_ns = now_ns - self._settle_ns
        while self._said and self._said[0][0] <= settled_ns:
            said_ns, run_id, last = self._said.popleft()
            self._extend(run_id, last, said_ns)
        return self._report(settled_ns)

    def flush(self) -> list[Gap[Source]]:
        """Every gap not yet reported, however young: the recorder ends."""
        self._said.clear()
        return self._report(None)

    def highest(self, run_id: Source) -> int | None:
        """The highest keyframe that is known of this run, recorded or missing."""
        run = self._runs.get(run_id)
        return None if run is None else run.last

    def close(self, gap: Gap[Source]) -> None:
        """Take what is missing of ``gap`` for recorded."""
        run = self._runs.get(gap.run_id)
        index = run.holes_before(gap.first - 1) if run is not None else 0
        while run is not None and index < len(run.holes) and run.holes[index].last <= gap.last:
            self._remove(run, index)

    def forget(self, run_id: Source) -> list[Gap[Source]]:
        """Know nothing of this run any more; what is missing of it and was not yet reported."""
        run = self._runs.pop(run_id)
        gaps = [Gap(run_id, hole.first, hole.last) for hole in run.holes if not hole.reported]
        while run.holes:
            self._remove(run, 0)
        return gaps

    def gaps(self) -> Iterator[Gap[Source]]:
        """Everything that is missing now, reported or not, in the order the runs began."""
        for run in self._runs.values():
            for hole in run.holes:
                yield Gap(run.run_id, hole.first, hole.last)

    def reported_gaps(self) -> Iterator[Gap[Source]]:
        """What is missing now and has been reported, in the order the runs began."""
        for run in self._runs.values():
            for hole in run.holes:
                if hole.reported:
                    yield Gap(run.run_id, hole.first, hole.last)

    def missing_reported(self) -> int:
        """How many of the missing keyframes have been reported."""
        return sum(gap.count for gap in self.reported_gaps())

    def state(self) -> tuple[RunState[Source], ...]:
        """Everything `restore` needs to go on from here, but for how long holes have been open."""
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
        """Fill a new ledger; holes not yet reported count as open since ``now_ns``."""
        for saved in runs:
            run = self._runs[saved.run_id] = _Run(saved.run_id, saved.first, saved.last)
            for first, last, reported in saved.holes:
                self._add(run, len(run.holes), _Hole(run.run_id, first, last, now_ns, reported))

    def _open(self, run: _Run[Source], index: int, first: int, last: int, now_ns: int) -> None:
        self._add(run, index, _Hole(run.run_id, first, last, now_ns))

    def _add(self, run: _Run[Source], index: int, hole: _Hole[Source]) -> None:
        run.holes.insert(index, hole)
        self.missing += hole.count
        if not hole.reported:
            self._opened += 1
            heapq.heappush(self._young, (hole.since_ns, self._opened, hole))

    def _fill(self, run: _Run[Source], keyframe_id: int) -> None:
        index = run.holes_before(keyframe_id) - 1
        if index < 0 or keyframe_id > run.holes[index].last:
            self.duplicates += 1
            return
        self._cut(run, index, keyframe_id, keyframe_id)
        self._remove(run, run.holes_before(keyframe_id) - 1)

    def _extend(self, run_id: Source, last: int, now_ns: int) -> None:
        """All up to ``last`` were sent; a hole is what is not recorded of them."""
        run = self._runs.get(run_id)
        if run is not None and last > run.last:
            self._open(run, len(run.holes), run.last + 1, last, now_ns)
            run.last = last

    def _cut(self, run: _Run[Source], index: int, first: int, last: int) -> None:
        """Make the part from ``first`` to ``last`` of a hole a hole of its own."""
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
        """In the order of run ids and keyframes, so that equal ledgers report equally."""
        reported = []
        while self._young and (open_since_ns is None or self._young[0][0] <= open_since_ns):
            hole = heapq.heappop(self._young)[2]
            if not (hole.reported or hole.closed):
                hole.reported = True
                reported.append(Gap(hole.run_id, hole.first, hole.last))
        return sorted(reported, key=lambda gap: (gap.run_id, gap.first))
