"""Which of the gaps that a log reports are still open: a late keyframe closes its gap, be it before
or after somebody looked. A gap ledger is folded over the log, as `log info` and `status` do."""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

from eventsrc.losses import Gap, GapLedger


class OpenGaps(NamedTuple):
    """How many keyframes of a run were reported missing and never came, and the offsets of the
    first and the last event that reports any of them."""

    run_id: str
    missing: int
    first_offset: int
    last_offset: int


class ReportedGaps:
    """Takes keyframes and reported gaps in offset order."""

    def __init__(self) -> None:
        self._ledger = GapLedger()
        self._reports: defaultdict[str, list[tuple[int, Gap]]] = defaultdict(list)

    def take_keyframe(self, run_id: str, keyframe_id: int) -> None:
        """One that is recorded."""
        self._ledger.record(run_id, keyframe_id, 0)

    def take_report(self, offset: int, gap: Gap) -> None:
        """The loss event at ``offset`` reports ``gap``."""
        self._reports[gap.run_id].append((offset, gap))
        self._ledger.assume(gap, 0)

    def still_open(self) -> Iterator[OpenGaps]:
        """By run, what is still missing."""
        missing: defaultdict[str, list[Gap]] = defaultdict(list)
        for gap in self._ledger.reported_gaps():
            missing[gap.run_id].append(gap)
        for run_id, gaps in missing.items():
            ends = [gap.last for gap in gaps]
            offsets = [
                offset
                for offset, reported in self._reports[run_id]
                if (index := bisect_left(ends, reported.first)) < len(gaps)
                and gaps[index].first <= reported.last
            ]
            yield OpenGaps(run_id, sum(gap.count for gap in gaps), offsets[0], offsets[-1])
