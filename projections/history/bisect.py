"""Finding when a condition over the map turned true: binary search where it is sure, else a scan.

An expression that can only turn true once (`Direction.RISING`) is searched; it and its answer are
then checked at two neighbouring offsets by construction. Any other one is asked after every event:
the history answers in logarithmic time, so that is no second fold. So the answer is always the
first offset at which the condition *became* true, whatever the condition.

Answers to an expression's questions, read from a history at any offset in logarithmic time.

So asking at every offset of a log costs about one fold's walk over its events, not one fold each.
A scan is as cheap as that and needs no assumption about the expression.
"""

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from eventsrc.envelope import KeyframeId, Offset, RunId
from projections.deltas import KeyframeOrdinal

from .condition_functions import Direction, Names, Value
from .conditions import Expression
from .history import NEVER, History
from .records import Cause, count_before


class Tallies:
    """Sorted offsets at which counts went up or down, made once from a history."""

    def __init__(self, history: History) -> None:
        self.posed = array("q", (k.offset for k in history.keyframes if k.pose is not None))
        self.placed = _sorted(offset for offset in history.placed_offsets if offset != NEVER)
        self.formed = _sorted(life.formed.offset for life in history.places)
        self.absorbed = _sorted(m.cause.offset for m in history.merges for _ in m.absorbed)
        self.keyframes_of: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        self.objects_of: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        for keyframe in history.keyframes:
            self.keyframes_of[keyframe.run_id].append(keyframe.offset)
        for life in history.objects:
            self.objects_of[life.found.class_name].append(life.found.offset)
        self.objects = _sorted(life.found.offset for life in history.objects)


def _sorted(offsets: Iterable[int]) -> "array[int]":
    return array("q", sorted(offsets))


class HistoryFacts:
    """The map after the events below ``end``, which may be moved; answers `expression.Facts`."""

    def __init__(self, history: History, tallies: Tallies, end: Offset) -> None:
        self._history = history
        self._tallies = tallies
        self.end = end

    def place_count(self) -> int:
        return self._count(self._tallies.formed) - self._count(self._tallies.absorbed)

    def noise_count(self) -> int:
        return self._count(self._tallies.posed) - self._count(self._tallies.placed)

    def keyframe_count(self, run_id: str | None = None) -> int:
        if run_id is None:
            return self._history.keyframe_count(self.end)
        return self._count(self._tallies.keyframes_of.get(run_id, ()))

    def object_count(self, class_name: str | None = None) -> int:
        if class_name is None:
            return self._count(self._tallies.objects)
        return self._count(self._tallies.objects_of.get(class_name, ()))

    def place_of(self, keyframe: str) -> str | None:
        number = keyframe_number(self._history, keyframe)
        return None if number is None else self._place_id(self._history.place_at(number, self.end))

    def located_in(self, object_id: str) -> str | None:
        number = self._history.object_numbers.get(object_id)
        if number is None:
            return None
        return self._place_id(self._history.objects[number].place(self.end))

    def sightings(self, object_id: str) -> int:
        number = self._history.object_numbers.get(object_id)
        return 0 if number is None else count_before(self._history.objects[number].seen, self.end)

    def size(self, place_id: str) -> int:
        number = self._history.place_numbers.get(place_id)
        if number is None or not self._history.places[number].stands(self.end):
            return 0
        change = self._history.places[number].change(self.end)
        return 0 if change is None else change.keyframe_count

    def transitions(self, a: str, b: str) -> int:
        first, second = (self._history.place_numbers.get(place) for place in (a, b))
        if first is None or second is None:
            return 0
        return self._history.transitions(first, second, self.end)

    def merged(self, place_id: str) -> bool:
        number = self._history.place_numbers.get(place_id)
        if number is None:
            return False
        merge = self._history.places[number].absorbed
        return merge is not None and merge.cause.offset < self.end

    def names(self, kind: Names) -> Iterable[str]:
        """The names of all things of a kind in the whole history."""
        match kind:
            case Names.KEYFRAME:
                return [f"{k.run_id}:{k.keyframe_id}" for k in self._history.keyframes]
            case Names.PLACE:
                return self._history.place_numbers.keys()
            case Names.OBJECT:
                return self._history.object_numbers.keys()
            case Names.CLASS:
                return self._tallies.objects_of.keys()
            case Names.RUN:
                return self._tallies.keyframes_of.keys()

    def _count(self, offsets: "array[int] | tuple[()]") -> int:
        return bisect_left(offsets, self.end)

    def _place_id(self, place: int | None) -> str | None:
        return None if place is None else self._history.places[place].place_id


def keyframe_number(history: History, text: str) -> KeyframeOrdinal | None:
    """The ordinal of the keyframe ``run_id:keyframe_id`` names; a run id may hold colons."""
    run_id, _, number = text.rpartition(":")
    try:
        return history.keyframe_numbers.get((RunId(run_id), KeyframeId(int(number))))
    except ValueError:
        return None


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
    start: Offset
    end: Offset
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
        self, expression: Expression, facts: HistoryFacts, cause_at: Callable[[Offset], Cause]
    ) -> None:
        self._expression = expression
        self._facts = facts
        self._cause_at = cause_at
        self._asked = 0

    def search(self, start: Offset, end: Offset, *, scan: bool) -> Search:
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

    def _holds(self, end: Offset) -> bool:
        self._asked += 1
        self._facts.end = end
        return self._expression.holds(self._facts)

    def _bisect(self, low: int, high: int) -> Turn:
        """False after ``low`` events, true after ``high``."""
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
