"""The bounded queue between the threads that receive from Zenoh and the log's writer thread.

A message that finds the queue full waits for room, for at most `MAX_WAIT_S`: meanwhile the network
waits too, so a publisher that blocks is slowed down to the pace of the disk and loses nothing. The
limit must be well below the five seconds after which Zenoh gives up a link and silently drops its
messages. A queue that stays full that long has a stuck writer: until half of it is free again,
messages that do not fit are lost at once. They are counted by key, and the writer thread records
the counts in the log.

The queue also finds gaps in the sequence numbers that Zenoh's advanced publishers give their
messages and repeat in heartbeats. A message that did not fit into the queue has still arrived, so
it is no such gap.
"""

import threading
import time
from collections import deque
from collections.abc import Iterable
from typing import Final

from eventsrc.envelope.gaps import DEFAULT_SETTLE_NS, Gap, GapLedger
from eventsrc.record.robot.acks import SENT_SUFFIX
from eventsrc.record.transport.config import MAX_KEY_BYTES
from eventsrc.record.transport.session import Received, SequenceNumber

from .edits import MAX_EDITS_WAITING, EditRequest

MAX_SOURCES: Final = 4_096
_NUMBERS: Final = 2**32


class SequenceGaps:
    """Gaps in publishers' sequence numbers. Pure; not thread-safe.

    The rules are those of the gap ledger (`eventsrc.envelope.gaps`), with publishers in place of
    runs, and:

    * A publisher is known from its first message or heartbeat on; earlier losses are not seen.
    * Numbers have 32 bits and wrap around to 0; gaps are given with the wrapped-off part added.
    * A gap that was returned counts as closed, and at most `MAX_SOURCES` publishers are tracked,
      so forged publishers and numbers cannot fill the memory.
    """

    def __init__(self, settle_ns: int = DEFAULT_SETTLE_NS) -> None:
        self._ledger: GapLedger[str] = GapLedger(settle_ns)
        self._sources: dict[str, None] = {}
        self._forgotten: list[Gap[str]] = []

    def record(self, number: SequenceNumber, now_ns: int) -> None:
        """Note the arrival of a message."""
        self._ledger.record(number.source, self._unwrap(number), now_ns)
        self._track(number.source)

    def expect(self, number: SequenceNumber, now_ns: int) -> None:
        """Note a heartbeat: ``number`` is the last that its publisher has given."""
        value = self._unwrap(number)
        if number.source in self._sources:
            self._ledger.expect(number.source, value, now_ns)
        else:
            self.record(number, now_ns)

    def due(self, now_ns: int) -> list[Gap[str]]:
        """Gaps that were open for the settling time, each once."""
        return self._close(self._ledger.due(now_ns))

    def flush(self) -> list[Gap[str]]:
        """All open gaps."""
        return self._close(self._ledger.flush())

    def _close(self, gaps: list[Gap[str]]) -> list[Gap[str]]:
        for gap in gaps:
            self._ledger.close(gap)
        forgotten, self._forgotten = self._forgotten, []
        return forgotten + gaps

    def _track(self, source: str) -> None:
        if source in self._sources:
            return
        self._sources[source] = None
        if len(self._sources) > MAX_SOURCES:
            oldest = next(iter(self._sources))
            del self._sources[oldest]
            self._forgotten += self._ledger.forget(oldest)

    def _unwrap(self, number: SequenceNumber) -> int:
        """The number closest to the source's highest with these lower 32 bits."""
        highest = self._ledger.highest(number.source)
        if highest is None:
            return number.value
        ahead = (number.value - highest + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2
        return highest + ahead


DEFAULT_QUEUE_SIZE: Final = 16_384
"""Messages: at 9 kB each about 150 MB, and 0.8 s at 20,000 a second."""
DEFAULT_QUEUE_BYTES: Final = 160 * 1024 * 1024
"""Payload bytes, which bound the memory taken by large messages."""
MAX_BATCH_BYTES: Final = 16 * 1024 * 1024
"""Payload bytes after which `MessageQueue.get` ends a batch."""
MAX_KEYS: Final = 1_000
"""How many keys have loss counts of their own between two `drain_overflow`."""
OTHER_KEYS: Final = "**"
"""Key for the losses of all further keys and of keys that are too long."""
MAX_WAIT_S: Final = 1.0
"""How long a message may wait for room: longer than a sync takes, much less than five seconds."""


class BridgedMessage(Received, frozen=True, gc=False):
    """A message of ROS that a bridge sent, in CDR."""


class CropMessage(Received, frozen=True, gc=False):
    """The JPEG of a detection, under ``PREFIX/DET_ID`` (`eventsrc.envelope.crops`)."""


class MessageQueue:
    """The bounded queue of messages: many threads call `put`, one thread calls `get`.

    Holds at most ``size`` messages and ``max_bytes`` of payload, or a single larger message.
    """

    def __init__(
        self,
        size: int = DEFAULT_QUEUE_SIZE,
        max_bytes: int = DEFAULT_QUEUE_BYTES,
        max_wait_s: float = MAX_WAIT_S,
    ) -> None:
        if size < 1:
            raise ValueError(f"queue of {size} messages; at least 1")
        self.size = size
        self._max_bytes = max_bytes
        self._max_wait_s = max_wait_s
        self._may_wait = True
        self._bytes = 0
        self._messages: deque[Received | EditRequest] = deque()
        self._edits = 0
        self._overflow: dict[str, int] = {}
        self._sequence_gaps = SequenceGaps()
        self.overflowed = 0
        """Messages that did not fit, in all."""
        self.missed = 0
        """Messages that never came by their publishers' sequence numbers, in all."""
        self._lock = threading.Lock()
        self._filled = threading.Condition(self._lock)
        self._emptied = threading.Condition(self._lock)
        self._getting = False
        self._putting = 0
        self._closed = False

    def put(self, message: Received) -> None:
        """Add a message, or count it as lost if there is no room in time."""
        self.put_all((message,))

    def put_all(self, messages: Iterable[Received]) -> None:
        """Add messages in order, and count those as lost that find no room in time."""
        with self._lock:
            for message in messages:
                if message.number is not None:
                    self._sequence_gaps.record(message.number, time.monotonic_ns())
                if self._fits(message) or self._wait_for_room(message):
                    self._messages.append(message)
                    self._bytes += len(message.payload)
                elif not message.key.endswith(SENT_SUFFIX):  # an announcement is no event
                    self.overflowed += 1
                    _count(self._overflow, message.key)
            if self._getting:
                self._filled.notify()

    def put_edit(self, request: EditRequest) -> bool:
        """Add a command without waiting; False if there is no room for it."""
        with self._lock:
            full = self._closed or self._edits >= MAX_EDITS_WAITING or not self._fits(request)
            if not full:
                self._edits += 1
                self._messages.append(request)
                self._bytes += len(request.payload)
                if self._getting:
                    self._filled.notify()
            return not full

    def put_heartbeat(self, number: SequenceNumber) -> None:
        """Note the last sequence number that a publisher has given."""
        with self._lock:
            self._sequence_gaps.expect(number, time.monotonic_ns())

    def get(self, limit: int, timeout_s: float) -> list[Received | EditRequest]:
        """Remove up to ``limit`` messages in order, fewer if they are large; none if none came in
        time or the queue is closed."""
        with self._lock:
            if not self._messages and not self._closed and timeout_s > 0:
                self._getting = True
                self._filled.wait(timeout_s)
                self._getting = False
            batch: list[Received | EditRequest] = []
            size = 0
            while self._messages and len(batch) < limit and size < MAX_BATCH_BYTES:
                message = self._messages.popleft()
                batch.append(message)
                size += len(message.payload)
                self._edits -= isinstance(message, EditRequest)
            self._bytes -= size
            self._may_wait = self._may_wait or 2 * len(self._messages) <= self.size
            if self._putting:
                self._emptied.notify_all()
            return batch

    def drain_overflow(self) -> dict[str, int]:
        """Messages that did not fit since the last call, by key."""
        with self._lock:
            overflow, self._overflow = self._overflow, {}
            return overflow

    def drain_missed(self, now_ns: int | None) -> list[Gap[str]]:
        """Gaps in sequence numbers, each once: those that have settled at ``now_ns``, or all."""
        with self._lock:
            found = self._sequence_gaps
            gaps = found.flush() if now_ns is None else found.due(now_ns)
            self.missed += sum(gap.count for gap in gaps)
            return gaps

    def close(self) -> None:
        """Wake every waiting thread; later `put` and `get` do not wait."""
        with self._lock:
            self._closed = True
            self._may_wait = False
            self._filled.notify_all()
            self._emptied.notify_all()

    @property
    def closed(self) -> bool:
        """Whether `close` was called; messages may still be in the queue."""
        return self._closed

    def depth(self) -> int:
        """Number of messages in the queue."""
        return len(self._messages)

    def _fits(self, message: Received | EditRequest) -> bool:
        if not self._messages:
            return True
        fits_in = self._bytes + len(message.payload) <= self._max_bytes
        return fits_in and len(self._messages) < self.size

    def _wait_for_room(self, message: Received) -> bool:
        if not self._may_wait:
            return False
        self._putting += 1
        self._filled.notify()  # of messages put before this one
        self._emptied.wait_for(lambda: self._fits(message) or not self._may_wait, self._max_wait_s)
        self._putting -= 1
        fits = self._fits(message)
        if not fits:
            self._may_wait = False
        return fits


def _count(counts: dict[str, int], key: str) -> None:
    if key not in counts and (len(counts) >= MAX_KEYS or len(key) > MAX_KEY_BYTES):
        key = OTHER_KEYS
    counts[key] = counts.get(key, 0) + 1
