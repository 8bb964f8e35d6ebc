"""A process that parses ranges of a log for the process that folds it.

It receives a range of offsets, parses it into one of the slots of a shared memory, and replies with
the position in the slot. It writes nothing else, so it may be killed at any moment. If it cannot
read a range, it only reports that; the folding process reads the range again and gets the error.
"""

import contextlib
import gc
import mmap
import struct
from collections import deque
from collections.abc import Iterator
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final

from eventsrc.base.errors import MapfoldError
from eventsrc.base.worker_process import ProcessGone, WorkerProcess, unnamed_memory
from eventsrc.envelope.model import Offset
from eventsrc.log import Event, LogReader

from .parsed_bytes import NoRoom, Packed, pack, unpack
from .parsing import READ_AHEAD, ParsedEvent

SLOTS: Final = 4
"""The most ranges that a process has parsed ahead of the fold."""
SLOT_BYTES: Final = 8 * 1024 * 1024
"""Bytes of a slot: five times those of a range of detections with embeddings only. Memory is used
only as far as it is written."""
PATIENCE_S: Final = 60.0
"""Seconds to wait for one range; an idle machine parses a hundred a second."""
_PROGRAM: Final = (
    "import sys; from projections.map.parsing_process import main; main(*sys.argv[1:])"
)
_QUESTION: Final = struct.Struct("<qqq")
"""Slot, first offset, offset after the last one."""
_ANSWER: Final = struct.Struct("<qq")
_UNREADABLE: Final = Packed(-1, 0)


class ParsingProcess(WorkerProcess):
    """A context manager. Raises ProcessGone if the process cannot be started."""

    def __init__(self, log: Path, log_id: str) -> None:
        self._slots: deque[int] = deque(range(SLOTS))
        self._asked: deque[int] = deque()
        self._is_ready = False
        try:
            with unnamed_memory(SLOTS * SLOT_BYTES) as shared:
                self._memory = memoryview(mmap.mmap(shared, SLOTS * SLOT_BYTES))
                super().__init__(_PROGRAM, str(log.absolute()), log_id, memory=shared)
        except OSError as error:
            raise ProcessGone(str(error)) from error

    @property
    def waiting(self) -> int:
        """The number of ranges that were assigned and not yet taken."""
        return len(self._asked)

    def can_take_more(self) -> bool:
        """Whether it has started, and has a slot that is free. Raises ProcessGone."""
        if not self._is_ready and self.has_answer():
            self.receive()
            self._is_ready = True
        return self._is_ready and bool(self._slots)

    def ask(self, start: Offset, end: Offset) -> None:
        """Assign a range. Raises ProcessGone."""
        slot = self._slots.popleft()
        self._asked.append(slot)
        self.send(_QUESTION.pack(slot, start, end))

    def take(self) -> Iterator[list[ParsedEvent]] | None:
        """The events of the oldest assigned range, to be read to the end before the next call; None
        if the process could not read them. Raises ProcessGone."""
        if not self.has_answer(PATIENCE_S):
            raise ProcessGone(f"no answer for {PATIENCE_S:.0f} s")
        packed = Packed(*_ANSWER.unpack(self.receive()))
        slot = self._asked.popleft()
        if packed == _UNREADABLE:
            self._slots.append(slot)
            return None
        return self._read(slot, packed)

    def _read(self, slot: int, packed: Packed) -> Iterator[list[ParsedEvent]]:
        yield from unpack(packed, _slot(self._memory, slot))
        self._slots.append(slot)


def _slot(memory: memoryview, slot: int) -> memoryview:
    return memory[slot * SLOT_BYTES : (slot + 1) * SLOT_BYTES]


def main(log: str, log_id: str, connection: str, memory: str) -> None:
    """Run in the process: parse range after range, until the connection is closed."""
    gc.disable()  # parsing makes no reference cycles
    slots = memoryview(mmap.mmap(int(memory), SLOTS * SLOT_BYTES))
    with (
        contextlib.suppress(EOFError, ConnectionError),
        Connection(int(connection)) as asked,
        LogReader(Path(log)) as reader,
    ):
        if reader.log_id != log_id:
            return
        asked.send_bytes(b"ready")
        while True:
            slot, start, end = _QUESTION.unpack(asked.recv_bytes())
            asked.send_bytes(_ANSWER.pack(*_parse(reader, start, end, _slot(slots, slot))))


def _parse(reader: LogReader, start: Offset, end: Offset, slot: memoryview) -> Packed:
    events = _in_order(reader.read(start, end), start, end)
    try:
        return pack(iter(lambda: list(islice(events, READ_AHEAD)), []), slot)
    except (MapfoldError, NoRoom):
        return _UNREADABLE


def _in_order(events: Iterator[Event], start: Offset, end: Offset) -> Iterator[Event]:
    """Pass the events on. Raises NoRoom if some of the range are missing, as in a log that was
    cut."""
    at: int = start
    for event in events:
        yield event
        at += 1
    if at != end:
        raise NoRoom
