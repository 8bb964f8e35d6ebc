"""Finding when a condition over the map turned true: binary search where it is sure, else a scan.

An expression that can only turn true once (`Direction.RISING`) is searched; it and its answer are
then checked at two neighbouring offsets by construction. Any other one is asked after every event:
the history answers in logarithmic time, so that is no second fold. So the answer is always the
first offset at which the condition *became* true, whatever the condition.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from .causes import Cause
from .condition_functions import Direction, Value
from .conditions import Expression
from .facts import HistoryFacts

Readings = tuple[tuple[str, Value], ...]


@dataclass(frozen=True, slots=True)
class Turn:
    """The condition turned: false before the event of ``cause``, true after it, or the reverse.

    It shows from ``--at`` ``cause.offset + 1`` on.
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
    """When ``expression`` turned between ``start`` and ``end``.

    ``found`` is the first turn to true, None if there is none; ``turns`` are all turns when a scan
    was asked for, else those up to ``found``. ``holds`` says whether it is true at the start and at
    the end, ``at_end`` what it reads there. ``asked`` is how many maps were asked.
    """

    expression: Expression
    start: int
    end: int
    holds: tuple[bool, bool]
    found: Turn | None
    turns: tuple[Turn, ...]
    at_end: Readings
    asked: int

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
            "maps_asked": self.asked,
        }


class Searcher:
    """Asks one expression of one history at many offsets, and counts."""

    def __init__(
        self, expression: Expression, facts: HistoryFacts, cause_at: Callable[[int], Cause]
    ) -> None:
        self._expression = expression
        self._facts = facts
        self._cause_at = cause_at
        self._asked = 0

    def search(self, start: int, end: int, *, scan: bool) -> Search:
        """The first turn to true by an event in ``start`` … ``end`` − 1; with ``scan``, all."""
        holds = self._holds(start), self._holds(end)
        rising = self._expression.direction in (Direction.RISING, Direction.STEADY)
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
            self._asked,
        )

    def _holds(self, end: int) -> bool:
        self._asked += 1
        self._facts.end = end
        return self._expression.holds(self._facts)

    def _bisect(self, low: int, high: int) -> Turn:
        """False after ``low`` events, true after ``high``."""
        while high - low > 1:
            middle = (low + high) // 2
            if self._holds(middle):
                high = middle
            else:
                low = middle
        return self._turn(high - 1, becomes=True)

    def _scan(self, start: int, end: int, now: bool, *, stop: bool) -> Iterator[Turn]:
        for offset in range(start, end):
            after = self._holds(offset + 1)
            if after is not now:
                yield self._turn(offset, becomes=after)
                if after and stop:
                    return
            now = after

    def _turn(self, offset: int, *, becomes: bool) -> Turn:
        before, after = self._readings(offset), self._readings(offset + 1)
        return Turn(self._cause_at(offset), becomes, before, after)

    def _readings(self, end: int) -> Readings:
        self._facts.end = end
        return self._expression.readings(self._facts)
