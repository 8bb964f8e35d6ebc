"""Log times of imported messages without a time of receipt.

A viewer plays a log by its log times. So an imported envelope has its stamp as its log time, and a
drive of eight minutes plays eight minutes; the time of the import is in the segment's metadata.

Log times imitate times of receipt. They do not go back for a keyframe that was sent late, or where
the clocks of two robots differ a little. They go back where an older drive follows, and where a
robot's clock was set back.
"""

from bisect import bisect_left
from typing import Final

from eventsrc.envelope.model import RunId

TOGETHER_NS: Final = 10 * 1_000_000_000
"""A run whose first stamp is at most this long before the last log time counts as simultaneous."""
CLOCK_SET_NS: Final = 24 * 3600 * 1_000_000_000
"""A keyframe stamped longer than this before its run's latest log time means that the robot's clock
was set back."""


class LogTimes:
    """The log times of messages, in the order in which they are appended; int nanoseconds.

    Each takes logarithmic time, whatever the number of runs.
    """

    def __init__(self) -> None:
        self._count = 0
        self._starts: dict[RunId, int] = {}
        """The number of the first message of each run, or of the first since its clock was set."""
        self._numbers: list[int] = []
        self._peaks: list[int] = []
        """The log times that are higher than those of all later messages, so in falling order;
        ``_numbers`` are the numbers of their messages."""
        self.last_ns: int | None = None

    def add(self, logged_ns: int) -> int:
        """Add a message with the log time ``logged_ns``, which is returned."""
        while self._peaks and self._peaks[-1] <= logged_ns:
            self._peaks.pop()
            self._numbers.pop()
        self._peaks.append(logged_ns)
        self._numbers.append(self._count)
        self._count += 1
        self.last_ns = logged_ns
        return logged_ns

    def add_stamped(self, run_id: RunId, stamp_ns: int) -> int:
        """Add a keyframe of a run by its stamp; return its log time."""
        start = self._starts.get(run_id)
        if start is None:
            together = self.last_ns is not None and 0 <= self.last_ns - stamp_ns <= TOGETHER_NS
            latest_ns = self.last_ns if together else None
        else:
            latest_ns = self._peaks[bisect_left(self._numbers, start)]
            if latest_ns - stamp_ns > CLOCK_SET_NS:
                start = latest_ns = None
        if start is None:
            self._starts[run_id] = self._count
        return self.add(stamp_ns if latest_ns is None else max(stamp_ns, latest_ns))
