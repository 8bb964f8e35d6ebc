"""Which numbered messages never came. Pure; times are given to it. The inbox's lock guards it.

Zenoh's advanced publishers number their messages, and tell the last number from time to time. A
plain subscription receives the numbers too, so a gap in them is found without anything being held
back or dropped. The rules are those of the gap ledger (`eventsrc.losses`), with publishers in
place of runs, and these:

* A publisher is known from its first message or heartbeat on; what it sent before nobody can know.
* The numbers have 32 bits. After the last comes 0; here they go on.
* What was reported is not missing any more, and only so many publishers are known at a time: who
  forges publishers and numbers shall not fill the memory.
"""

from typing import Final

from eventsrc._zenoh import Number
from eventsrc.losses import DEFAULT_SETTLE_NS, Gap, GapLedger

MOST_SOURCES: Final = 4_096
_NUMBERS: Final = 2**32


class Numbering:
    """`arrived` and `told` take in what comes, `due` and `flush` tell what did not."""

    def __init__(self, settle_ns: int = DEFAULT_SETTLE_NS) -> None:
        self._ledger = GapLedger(settle_ns)
        self._sources: dict[str, None] = {}
        self._forgotten: list[Gap] = []

    def arrived(self, number: Number, now_ns: int) -> None:
        """A message with this number has come."""
        self._ledger.record(number.source, self._unwrapped(number), now_ns)
        self._know(number.source)

    def told(self, number: Number, now_ns: int) -> None:
        """Its publisher says that this is the last number it has given."""
        value = self._unwrapped(number)
        if number.source in self._sources:
            self._ledger.expect(number.source, value, now_ns)
        else:
            self.arrived(number, now_ns)

    def due(self, now_ns: int) -> list[Gap]:
        """The gaps that have settled: source, first and last number. Each is returned once."""
        return self._take(self._ledger.due(now_ns))

    def flush(self) -> list[Gap]:
        """Every gap, however young."""
        return self._take(self._ledger.flush())

    def _take(self, gaps: list[Gap]) -> list[Gap]:
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

    def _unwrapped(self, number: Number) -> int:
        """The number nearest to the source's highest that has these 32 bits."""
        highest = self._ledger.highest(number.source)
        if highest is None:
            return number.value
        ahead = (number.value - highest + _NUMBERS // 2) % _NUMBERS - _NUMBERS // 2
        return highest + ahead
