"""The parsed events of a log for one fold, read in this process or ahead of it by other processes.

Reading, verifying checksums, decompressing and parsing are half of the work of a rebuild and are
independent for each event. The fold is sequential, so it stays in this process, which gets the
parsed events in the order of the log. The result does not depend on the number of processes: every
process parses an event alike, and this one reads again every range that another could not read or
had not returned when it died. So damage is reported at the same event, with the same message, as
without processes.

While the processes start, this one reads the first ranges itself.
"""

import os
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from itertools import islice
from typing import Final

from eventsrc.base.worker_process import ProcessGone
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader

from .parsing import ParsedEvent, parsed_stretches
from .parsing_process import ParsingProcess

MAX_WORKERS: Final = 64
DEFAULT_WORKERS: Final = 4
"""The most processes by default: one is enough for a fold that takes longer than parsing."""
MIN_EVENTS: Final = 10_000
"""Events of a log from which a further process pays; its start takes half a second of another
processor."""
EVENTS_PER_WORKER: Final = 5_000
"""Events for each further process."""
_RANGE_BYTES: Final = 768 * 1024


def default_workers() -> int:
    """One process for each further processor that this one may use, at most `DEFAULT_WORKERS`."""
    if hasattr(os, "sched_getaffinity"):
        processors = len(os.sched_getaffinity(0))
    else:
        processors = os.cpu_count() or 1
    return min(processors - 1, DEFAULT_WORKERS)


class ParsedLog:
    """The first ``end`` events of a log. A context manager, which ends the processes.

    ``workers`` is how many processes may be started, 0 for none. ``started`` are those that were,
    ``lost`` those of them that died or did not answer.
    """

    def __init__(self, reader: LogReader, end: Offset, workers: int) -> None:
        self._reader = reader
        self._end = end
        self._most = min(workers, end // EVENTS_PER_WORKER) if end >= MIN_EVENTS else 0
        self._processes = ExitStack()
        self._alive: list[ParsingProcess] = []
        self.started = 0
        self.lost = 0

    def __enter__(self) -> "ParsedLog":
        with suppress(ProcessGone):  # without it, this process reads
            while self.started < self._most:
                process = ParsingProcess(self._reader.path, self._reader.log_id)
                self._alive.append(self._processes.enter_context(process))
                self.started += 1
        return self

    def __exit__(self, *_: object) -> None:
        self._alive.clear()
        self._processes.close()

    def stretches(self) -> Iterator[list[ParsedEvent]]:
        """The events, a few at a time. Raises LogDamaged after those before the damage."""
        if not self._alive:
            yield from self._here(FIRST_OFFSET, self._end)
            return
        ranges = self._reader.stretches(FIRST_OFFSET, self._end, _RANGE_BYTES)
        asked: deque[tuple[Offset, Offset, ParsingProcess]] = deque()
        while True:
            self._ask(ranges, asked)
            if asked:
                start, end, process = asked.popleft()
                yield from self._taken(process) or self._here(start, end)
            elif (following := next(ranges, None)) is not None:
                yield from self._here(*following)
            else:
                return

    def _ask(
        self,
        ranges: Iterator[tuple[Offset, Offset]],
        asked: deque[tuple[Offset, Offset, ParsingProcess]],
    ) -> None:
        """Assign further ranges to the processes, first to those with the fewest."""
        while free := [process for process in self._alive if self._can_take_more(process)]:
            following = next(ranges, None)
            if following is None:
                return
            process = min(free, key=lambda each: each.waiting)
            asked.append((*following, process))
            try:
                process.ask(*following)
            except ProcessGone:
                self._give_up(process)

    def _can_take_more(self, process: ParsingProcess) -> bool:
        try:
            return process.can_take_more()
        except ProcessGone:
            self._give_up(process)
            return False

    def _taken(self, process: ParsingProcess) -> Iterator[list[ParsedEvent]] | None:
        """The events parsed by a process; None if it failed or has ended."""
        if process not in self._alive:
            return None
        try:
            return process.take()
        except ProcessGone:
            self._give_up(process)
            return None

    def _give_up(self, process: ParsingProcess) -> None:
        self._alive.remove(process)
        self.lost += 1

    def _here(self, start: Offset, end: Offset) -> Iterator[list[ParsedEvent]]:
        """Read and parse in this process. The reader's range ends at the end of the log, so that
        messages of damage are the same as without processes."""
        events = self._reader.read(start, self._end)
        yield from parsed_stretches(islice(events, end - start))
