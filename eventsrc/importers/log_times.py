"""Log times of imported messages that do not say when they were received.

A viewer plays a log by its log times. So an imported envelope has its stamp as its log time, and a
drive of eight minutes plays eight minutes; when it was imported is in the head of the segment.

Log times are those of the moment at which a message came: they do not run backwards because a
keyframe was sent late, or because the clocks of two robots differ a little. They do where an older
drive follows, and where a robot's clock was set back.
"""

from bisect import bisect_left
from typing import Final

from eventsrc.envelope import RunId

TOGETHER_NS: Final = 10 * 1_000_000_000
"""A run that begins up to this long before the message before it drives at the same time."""
CLOCK_SET_NS: Final = 24 * 3600 * 1_000_000_000
"""A keyframe is not sent later than this: the robot's clock was set back."""


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
        """The log times that no later message has reached, falling, and their numbers."""
        self.last_ns: int | None = None

    def add(self, logged_ns: int) -> int:
        """Add a message that was logged at ``logged_ns``; returns that."""
        while self._peaks and self._peaks[-1] <= logged_ns:
            self._peaks.pop()
            self._numbers.pop()
        self._peaks.append(logged_ns)
        self._numbers.append(self._count)
        self._count += 1
        self.last_ns = logged_ns
        return logged_ns

    def add_stamped(self, run_id: RunId, stamp_ns: int) -> int:
        """Add a keyframe; returns its log time."""
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
