"""The parsed events of a log for one fold, read in this process or ahead of it by other processes.

Reading, verifying checksums, decompressing and parsing are half of the work of a rebuild and are
independent for each event. The fold is sequential, so it stays in this process, which gets the
parsed events in the order of the log. The result does not depend on the number of processes: every
process parses an event alike, and this one reads again every range that another could not read or
had not returned when it died. So damage is reported at the same event, with the same message, as
without processes.

While the processes start, this one reads the first ranges itself.

A process receives a range of offsets, parses it into one of the slots of a memory that both share,
and replies with the position in the slot. It writes nothing else, so it may be killed at any
moment. First come the arrays of the vectors, stretch after stretch: float32 as recorded, then the
unit vectors in int32. After them everything else as MessagePack, which holds each float to the last
bit and is read straight into envelopes; those are without their embeddings' base64, which nothing
needs once it is decoded. A unit vector's -0.0 in float64 comes back as 0.0, which changes no
product and no sum.
"""

import gc
import mmap
import struct
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, suppress
from itertools import accumulate, islice, pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from eventsrc.base.errors import MapfoldError
from eventsrc.base.machine import usable_processors
from eventsrc.base.worker_process import ProcessGone, WorkerProcess, unnamed_memory
from eventsrc.envelope.ingest import Accepted, Rejected, Vector
from eventsrc.envelope.model import FIRST_OFFSET, DetId, Envelope, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import Event, LogReader
from projections.fold.exact import Units
from projections.fold.folded_ids import content_digest

from .parsing import READ_AHEAD, ParsedEvent, parse_events, parse_map, parsed_stretches


class _Event(msgspec.Struct, array_like=True, gc=False):
    """An event: a valid envelope with the other fields of `Accepted` but its vectors; the bytes of
    a map; the reason of a refusal; or nothing for an event that a fold skips."""

    offset: Offset
    logged_ns: int
    envelope: Envelope | None = None
    det_ids: tuple[DetId, ...] = ()
    digest: bytes = b""
    map: bytes | None = None
    refusal: str | None = None


class _Stretch(msgspec.Struct, array_like=True, gc=False):
    """Events; of their vectors the dimensions and squared norms, and where their arrays begin."""

    events: list[_Event]
    dims: list[int | None]
    norms: list[int | None]
    at: int


_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder(list[_Stretch]).decode


class Packed(NamedTuple):
    """The position of the part in MessagePack; the arrays precede it."""

    at: int
    length: int


class NoRoom(Exception):
    """The memory is too small for these events."""


def pack(stretches: Iterable[list[Event]], memory: memoryview) -> Packed:
    """Parse the events and write them. Raises NoRoom."""
    packed: list[_Stretch] = []
    at = 0
    for events in stretches:
        parsed = parse_events(events)
        units = [unit for each in parsed for unit in each.units]
        vectors = [
            v for each in parsed if isinstance(each.parsed, Accepted) for v in each.parsed.vectors
        ]
        dims = [None if vector is None else len(vector) for vector in vectors]
        norms = [None if unit is None else unit[2] for unit in units]
        found = [_packed(one, event) for one, event in zip(parsed, events, strict=True)]
        packed.append(_Stretch(found, dims, norms, at))
        at = _write_arrays(vectors, units, memory, at)
    document = _encode(packed)
    if at + len(document) > len(memory):
        raise NoRoom
    memory[at : at + len(document)] = document
    return Packed(at, len(document))


def unpack(packed: Packed, memory: memoryview) -> Iterator[list[ParsedEvent]]:
    """The parsed events that `pack` wrote, in its stretches. Afterwards nothing refers to the
    memory."""
    for stretch in _decode(memory[packed.at : packed.at + packed.length]):
        vectors, units = _read_arrays(stretch.dims, stretch.norms, memory, stretch.at)
        first, events = 0, []
        for event in stretch.events:
            stop = first + len(event.det_ids)
            parsed = _unpacked(event, tuple(vectors[first:stop]))
            events.append(ParsedEvent(event.offset, event.logged_ns, parsed, units[first:stop]))
            first = stop
        yield events


def _write_arrays(
    vectors: list[Vector | None], units: list[Units | None], memory: memoryview, at: int
) -> int:
    """Write the arrays at ``at`` and return the position after them."""
    total = sum(len(vector) for vector in vectors if vector is not None)
    exact_at = at + 4 * total
    end = exact_at + 4 * total
    if end > len(memory):
        raise NoRoom
    if total:
        given = [vector for vector in vectors if vector is not None]
        exact = [unit[1] for unit in units if unit is not None]
        np.concatenate(given, out=np.frombuffer(memory, np.float32, total, at))
        np.concatenate(exact, out=np.frombuffer(memory, np.int32, total, exact_at))
    return end


def _read_arrays(
    dims: list[int | None], norms: list[int | None], memory: memoryview, at: int
) -> tuple[list[Vector | None], list[Units | None]]:
    edges = [0, *accumulate(dim or 0 for dim in dims)]
    total = edges[-1]
    narrow = np.frombuffer(memory, np.float32, total, at).copy()
    exact = np.frombuffer(memory, np.int32, total, at + 4 * total).copy()
    wide = exact.astype(np.float64)
    if dims and dims[0] is not None and dims.count(dims[0]) == len(dims):  # rows are quicker
        shape = len(dims), dims[0]
        rows = zip(wide.reshape(shape), exact.reshape(shape), norms, strict=True)
        return list(narrow.reshape(shape)), list(rows)  # type: ignore[arg-type]
    vectors: list[Vector | None] = []
    units: list[Units | None] = []
    for norm2, (start, stop) in zip(norms, pairwise(edges), strict=True):
        is_given = norm2 is not None
        vectors.append(narrow[start:stop] if is_given else None)
        units.append((wide[start:stop], exact[start:stop], norm2) if norm2 is not None else None)
    return vectors, units


def _packed(event: ParsedEvent, read: Event) -> _Event:
    parsed, offset, logged_ns = event.parsed, event.offset, event.logged_ns
    if isinstance(parsed, Accepted):
        digest = content_digest(parsed)
        for detection in parsed.envelope.detections:
            force_setattr(detection, "embedding", None)
        return _Event(offset, logged_ns, parsed.envelope, parsed.det_ids, digest)
    if read.key == MAP_KEY:
        return _Event(offset, logged_ns, map=read.payload)
    refusal = parsed.reason if isinstance(parsed, Rejected) else None
    return _Event(offset, logged_ns, refusal=refusal)


def _unpacked(
    event: _Event, vectors: tuple[Vector | None, ...]
) -> Accepted | OccupancyMap | Rejected | None:
    if event.envelope is not None:
        return Accepted(event.envelope, event.det_ids, vectors, event.digest)
    if event.map is not None:
        return parse_map(event.map)
    return None if event.refusal is None else Rejected(event.refusal)


SLOTS: Final = 4
"""The most ranges that a process has parsed ahead of the fold."""
SLOT_BYTES: Final = 8 * 1024 * 1024
"""Bytes of a slot: five times those of a range of detections with embeddings only. Memory is used
only as far as it is written."""
PATIENCE_S: Final = 60.0
"""Seconds to wait for one range; an idle machine parses a hundred a second."""
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
                super().__init__(_parse_ranges, str(log.absolute()), log_id, memory=shared)
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


def _parse_ranges(connection: Connection, memory: str, log: str, log_id: str) -> None:
    """Run in the process: parse range after range, until the connection is closed."""
    gc.disable()  # parsing makes no reference cycles
    slots = memoryview(mmap.mmap(int(memory), SLOTS * SLOT_BYTES))
    with LogReader(Path(log)) as reader:
        if reader.log_id != log_id:
            return
        connection.send_bytes(b"ready")
        while True:
            slot, start, end = _QUESTION.unpack(connection.recv_bytes())
            connection.send_bytes(_ANSWER.pack(*_parse(reader, start, end, _slot(slots, slot))))


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
    return min(usable_processors() - 1, DEFAULT_WORKERS)


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
