"""The first event that made a condition over the map true: binary search or a scan.

A condition that can become true but not false again (`Direction.RISING`) is searched by bisection.
Any other one is evaluated after every event: a history gives each value in logarithmic time, so a
scan of a whole log costs about as much as iterating over its events, not a fold per event. The
answer is always the first offset at which the condition *became* true.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from eventsrc.envelope.model import Offset
from projections.store.history_records import Cause

from .condition_functions import Direction, HistoryFacts, Value
from .conditions import Expression

Readings = tuple[tuple[str, Value], ...]


@dataclass(frozen=True, slots=True)
class Turn:
    """An event that changed the truth of a condition; ``becomes`` is what it is after it.

    ``before`` and ``after`` are the values of the functions in the condition. The change shows from
    ``--at`` ``cause.offset + 1`` on.
    """

    cause: Cause
    becomes: bool
    before: Readings
    after: Readings

    def document(self) -> dict[str, Any]:
        return {
            **self.cause.document(),
            "at": self.cause.offset + 1,
            "becomes": self.becomes,
            "before": dict(self.before),
            "after": dict(self.after),
        }


@dataclass(frozen=True, slots=True)
class Search:
    """When ``expression`` turned true or false between ``start`` and ``end``.

    ``found`` is the first turn to true, None if there is none; ``turns`` are all turns of a full
    scan, else those up to ``found``. ``holds`` is its truth at the start and at the end, ``at_end``
    the values of its functions there. ``evaluations`` counts the offsets it was evaluated at.
    """

    expression: Expression
    start: Offset
    end: Offset
    holds: tuple[bool, bool]
    found: Turn | None
    turns: tuple[Turn, ...]
    at_end: Readings
    evaluations: int

    def document(self) -> dict[str, Any]:
        return {
            "expression": self.expression.source,
            "from": self.start,
            "to": self.end,
            "holds_at_start": self.holds[0],
            "holds_at_end": self.holds[1],
            "at_end": dict(self.at_end),
            "found": None if self.found is None else self.found.document(),
            "turns": [turn.document() for turn in self.turns],
            "maps_asked": self.evaluations,
        }


class Searcher:
    """Evaluates one expression over one history at many offsets."""

    def __init__(
        self, expression: Expression, facts: HistoryFacts, cause_at: Callable[[Offset], Cause]
    ) -> None:
        self._expression = expression
        self._facts = facts
        self._cause_at = cause_at
        self._evaluations = 0

    def search(self, start: Offset, end: Offset, *, scan: bool) -> Search:
        """The first turn to true by an event in ``start`` … ``end`` − 1; with ``scan``, all."""
        holds = self._holds(start), self._holds(end)
        rising = self._expression.direction in (Direction.RISING, Direction.STEADY)
        rising = rising and not self._facts.objects_merge
        if scan or not rising:
            turns = list(self._scan(start, end, holds[0], stop=not scan))
        else:
            turns = [] if holds[0] or not holds[1] else [self._bisect(start, end)]
        found = next((turn for turn in turns if turn.becomes), None)
        return Search(
            self._expression,
            start,
            end,
            holds,
            found,
            tuple(turns),
            self._readings(end),
            self._evaluations,
        )

    def _holds(self, end: Offset) -> bool:
        self._evaluations += 1
        self._facts.end = end
        return self._expression.holds(self._facts)

    def _bisect(self, low: int, high: int) -> Turn:
        """The turn of a rising condition, false after ``low`` events and true after ``high``."""
        while high - low > 1:
            middle = Offset((low + high) // 2)
            if self._holds(middle):
                high = middle
            else:
                low = middle
        return self._turn(Offset(high - 1), becomes=True)

    def _scan(self, start: Offset, end: Offset, now: bool, *, stop: bool) -> Iterator[Turn]:
        for offset in map(Offset, range(start, end)):
            after = self._holds(Offset(offset + 1))
            if after is not now:
                yield self._turn(offset, becomes=after)
                if after and stop:
                    return
            now = after

    def _turn(self, offset: Offset, *, becomes: bool) -> Turn:
        before, after = self._readings(offset), self._readings(Offset(offset + 1))
        return Turn(self._cause_at(offset), becomes, before, after)

    def _readings(self, end: Offset) -> Readings:
        self._facts.end = end
        return self._expression.readings(self._facts)
