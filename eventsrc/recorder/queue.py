"""The bounded queue between Zenoh's thread and the writer's.

Zenoh's callback only hands over. When the queue is full it waits a moment for room, because then
the network waits with it and a publisher that blocks is slowed down to the pace of the disk; that
loses nothing. But the wait is bounded, and shorter than the five seconds after which Zenoh gives a
link up and loses messages without a word: a writer that makes no room for that long is stuck. From
then on what does not fit is turned away at once and counted, per key, until the writer fetches the
count and writes it into the log; and when half the queue is free again, so is the patience.

A message that was turned away has come all the same: what is missing in its publisher's numbering
(`eventsrc.recorder.queue`) are only those that never came.

Which numbered messages never came. Pure; times are given to it. The inbox's lock guards it.

Zenoh's advanced publishers number their messages, and tell the last number from time to time. A
plain subscription receives the numbers too, so a gap in them is found without anything being held
back or dropped. The rules are those of the gap ledger (`eventsrc.gaps`), with publishers in
place of runs, and these:

* A publisher is known from its first message or heartbeat on; what it sent before nobody can know.
* The numbers have 32 bits. After the last comes 0; here they go on.
* What was reported is not missing any more, and only so many publishers are known at a time: who
  forges publishers and numbers shall not fill the memory.
"""

import threading
import time
from collections import deque
from typing import Final

from eventsrc.gaps import DEFAULT_SETTLE_NS, Gap, GapLedger
from eventsrc.robot.acks import SENT_SUFFIX
from eventsrc.transport.config import MAX_KEY_BYTES
from eventsrc.transport.session import Received, SequenceNumber

MOST_SOURCES: Final = 4_096
_NUMBERS: Final = 2**32


class Numbering:
    """`arrived` and `told` take in what comes, `due` and `flush` tell what did not."""

    def __init__(self, settle_ns: int = DEFAULT_SETTLE_NS) -> None:
        self._ledger: GapLedger[str] = GapLedger(settle_ns)
        self._sources: dict[str, None] = {}
        self._forgotten: list[Gap[str]] = []

    def arrived(self, number: SequenceNumber, now_ns: int) -> None:
        """A message with this number has come."""
        self._ledger.record(number.source, self._unwrapped(number), now_ns)
        self._know(number.source)

    def told(self, number: SequenceNumber, now_ns: int) -> None:
        """Its publisher says that this is the last number it has given."""
        value = self._unwrapped(number)
        if number.source in self._sources:
            self._ledger.expect(number.source, value, now_ns)
        else:
            self.arrived(number, now_ns)

    def due(self, now_ns: int) -> list[Gap[str]]:
        """The gaps that have settled: source, first and last number. Each is returned once."""
        return self._take(self._ledger.due(now_ns))

    def flush(self) -> list[Gap[str]]:
        """Every gap, however young."""
        return self._take(self._ledger.flush())

    def _take(self, gaps: list[Gap[str]]) -> list[Gap[str]]:
        for gap in gaps:
            self._ledger.close(gap)
        forgotten, self._forgotten = self._forgotten, []
        return forgotten + gaps

    def _know(self, source: str) -> None:
        if source in self._sources:
            return
        self._sources[source] = None
        if len(self._sources) > MOST_SOURCES:
            oldest = next(iter(self._sources))
            del self._sources[oldest]
            self._forgotten += self._ledger.forget(oldest)

    def _unwrapped(self, number: SequenceNumber) -> int:
        """The number nearest to the source's highest that has these 32 bits."""
        highest = self._ledger.highest(number.source)
        if highest is None:
            return number.value
        ahead = (number.value - highest + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2
        return highest + ahead


DEFAULT_QUEUE_SIZE: Final = 16_384
"""Messages. At 9 kB each about 150 MB, and two seconds of 8,000 a second."""
DEFAULT_QUEUE_BYTES: Final = 160 * 1024 * 1024
"""Payload bytes, so that a queue of large messages does not take all memory."""
TAKE_BYTES: Final = 16 * 1024 * 1024
"""Payload bytes after which `Inbox.take` takes no further message: what is taken makes room."""
MOST_KEYS: Final = 1_000
"""How many keys losses are counted for, each by itself, before the writer fetches the counts."""
OTHER_KEYS: Final = "**"
"""What the losses of all further keys, and of very long ones, are counted under."""
PATIENCE_S: Final = 1.0
"""How long a message may wait for room. Longer than a sync takes, far shorter than five seconds."""


class Inbox:
    """Many threads `put`, one thread takes.

    Holds at most ``size`` messages and, unless a single one is larger, ``max_bytes`` of payload.
    """

    def __init__(
        self,
        size: int = DEFAULT_QUEUE_SIZE,
        max_bytes: int = DEFAULT_QUEUE_BYTES,
        patience_s: float = PATIENCE_S,
    ) -> None:
        if size < 1:
            raise ValueError(f"queue of {size} messages; at least 1")
        self.size = size
        self._max_bytes = max_bytes
        self._patience_s = patience_s
        self._patient = True
        self._bytes = 0
        self._messages: deque[Received] = deque()
        self._overflow: dict[str, int] = {}
        self._too_large: dict[str, int] = {}
        self._numbering = Numbering()
        self.overflowed = 0
        """Messages that did not fit, since the beginning."""
        self.missed = 0
        """Messages that by their publishers' numbers never came, since the beginning."""
        self.too_large = 0
        """Messages that were too large to be taken from Zenoh, since the beginning."""
        self._lock = threading.Lock()
        self._filled = threading.Condition(self._lock)
        self._emptied = threading.Condition(self._lock)
        self._taking = False
        self._putting = 0
        self._closed = False

    def put(self, message: Received) -> None:
        """Hand over one message, or count it as lost when there is no room for it in time."""
        with self._lock:
            if message.number is not None:
                self._numbering.arrived(message.number, time.monotonic_ns())
            if self._fits(message) or self._wait_for_room(message):
                self._messages.append(message)
                self._bytes += len(message.payload)
            elif not message.key.endswith(SENT_SUFFIX):  # which says how far a robot has got
                self.overflowed += 1
                _count(self._overflow, message.key)
            if self._taking:
                self._filled.notify()

    def told(self, number: SequenceNumber) -> None:
        """Take in how far a publisher says it has got."""
        with self._lock:
            self._numbering.told(number, time.monotonic_ns())

    def refuse(self, key: str, number: SequenceNumber | None) -> None:
        """Count a message that is too large to be taken from Zenoh."""
        with self._lock:
            if number is not None:
                self._numbering.arrived(number, time.monotonic_ns())
            self.too_large += 1
            _count(self._too_large, key)

    def take(self, limit: int, timeout_s: float) -> list[Received]:
        """Up to ``limit`` messages in order, fewer if they are large; empty when none came in time
        or it is closed."""
        with self._lock:
            if not self._messages and not self._closed and timeout_s > 0:
                self._taking = True
                self._filled.wait(timeout_s)
                self._taking = False
            taken: list[Received] = []
            size = 0
            while self._messages and len(taken) < limit and size < TAKE_BYTES:
                message = self._messages.popleft()
                taken.append(message)
                size += len(message.payload)
            self._bytes -= size
            self._patient = self._patient or 2 * len(self._messages) <= self.size
            if self._putting:
                self._emptied.notify_all()
            return taken

    def take_overflow(self) -> dict[str, int]:
        """How many messages did not fit since the last call, by key."""
        with self._lock:
            overflow, self._overflow = self._overflow, {}
            return overflow

    def take_too_large(self) -> dict[str, int]:
        """How many messages were too large since the last call, by key."""
        with self._lock:
            too_large, self._too_large = self._too_large, {}
            return too_large

    def take_missed(self, now_ns: int | None) -> list[Gap[str]]:
        """The numbers that never came, each once: those long enough missing at ``now_ns``, or all
        that are missing."""
        with self._lock:
            numbering = self._numbering
            gaps = numbering.flush() if now_ns is None else numbering.due(now_ns)
            self.missed += sum(gap.count for gap in gaps)
            return gaps

    def close(self) -> None:
        """Wake everybody: nothing more will come, and nobody waits for room."""
        with self._lock:
            self._closed = True
            self._patient = False
            self._filled.notify_all()
            self._emptied.notify_all()

    @property
    def closed(self) -> bool:
        """Whether `close` was called; messages may still be waiting."""
        return self._closed

    def depth(self) -> int:
        """How many messages wait."""
        return len(self._messages)

    def _fits(self, message: Received) -> bool:
        if not self._messages:
            return True
        fits_in = self._bytes + len(message.payload) <= self._max_bytes
        return fits_in and len(self._messages) < self.size

    def _wait_for_room(self, message: Received) -> bool:
        if not self._patient:
            return False
        self._putting += 1
        self._emptied.wait_for(lambda: self._fits(message) or not self._patient, self._patience_s)
        self._putting -= 1
        fits = self._fits(message)
        if not fits:
            self._patient = False
        return fits


def _count(counts: dict[str, int], key: str) -> None:
    if key not in counts and (len(counts) >= MOST_KEYS or len(key) > MAX_KEY_BYTES):
        key = OTHER_KEYS
    counts[key] = counts.get(key, 0) + 1
