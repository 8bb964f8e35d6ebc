"""The first event that made a condition over the map true: binary search or a scan.

A condition that can become true but not false again (`Direction.RISING`) is searched by bisection.
Any other one is evaluated after every event: a history gives each value in logarithmic time, so a
scan of a whole log costs about as much as iterating over its events, not a fold per event. The
answer is always the first offset at which the condition *became* true.
"""

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eventsrc.envelope.model import Offset
from projections.store.history import NEVER, History
from projections.store.history_records import Cause, ObjectHistory, PlaceHistory

from .condition_functions import Direction, Names, Value
from .conditions import Expression
from .names import id_of_place, keyframe_name, keyframe_ordinal


class CountIndex:
    """Sorted offsets at which counts rise or fall, made once from a history."""

    def __init__(self, history: History) -> None:
        self.posed = history.posed_offsets()
        self.placed = _placed_offsets(history)
        self.formed = _sorted(place.formed.offset for place in history.places)
        self.absorbed = _sorted(m.cause.offset for m in history.merges for _ in m.absorbed)
        self.keyframes_of = history.offsets_by_run()
        self.objects_of: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        self.fused_of: defaultdict[str, array[int]] = defaultdict(lambda: array("q"))
        for each in history.objects:
            self._add_classes(each)
        for counts in (self.objects_of, self.fused_of):
            for class_name, offsets in counts.items():
                counts[class_name] = _sorted(offsets)
        self.objects = _sorted(each.found.offset for each in history.objects)
        self.fused = _sorted(merge.offset for merge in history.object_merges)
        self.refused = _sorted(refusal.cause.offset for refusal in history.refusals)
        self.places_called: defaultdict[str, list[PlaceHistory]] = defaultdict(list)
        for named in history.corrections.names:
            self.places_called[named.name] = []
        for place in history.places:
            for name in dict.fromkeys(named.name for named in place.names):
                if name is not None:
                    self.places_called[name].append(place)

    def _add_classes(self, record: ObjectHistory) -> None:
        """Add the offsets at which the object begins and ends to count for each class: it counts
        from being found or reclassified as the class, until reclassified again or absorbed."""
        name = record.found.class_name
        until = record.absorbed_by
        self.objects_of[name].append(record.found.offset)
        for classified in record.classes:
            self.fused_of[name].append(classified.offset)
            name = classified.class_name
            self.objects_of[name].append(classified.offset)
        if until is not None:
            self.fused_of[name].append(until.offset)


def _placed_offsets(history: History) -> Sequence[int]:
    """The events that placed keyframes, in order."""
    placed = np.asarray(history.placed_offsets)
    found: Any = np.sort(placed[placed != NEVER])
    return memoryview(found)


def _sorted(offsets: Iterable[int]) -> "array[int]":
    return array("q", sorted(offsets))


class HistoryFacts:
    """The values of the functions of conditions for the map after ``end`` events, read from a
    history; ``end`` may be assigned. Arguments are ids; a keyframe is ``run_id:keyframe_id``."""

    def __init__(self, history: History, index: CountIndex, end: Offset) -> None:
        self._history = history
        self._index = index
        self.end = end

    @property
    def objects_merge(self) -> bool:
        """Whether two objects became one, or changed their class: counts of objects may have
        fallen."""
        reclassified = (o.classes[0].offset for o in self._history.objects if o.classes)
        return self._count(self._index.fused) > 0 or any(at < self.end for at in reclassified)

    def place_count(self) -> int:
        return self._count(self._index.formed) - self._count(self._index.absorbed)

    def noise_count(self) -> int:
        return self._count(self._index.posed) - self._count(self._index.placed)

    def keyframe_count(self, run_id: str | None = None) -> int:
        if run_id is None:
            return self._history.keyframe_count(self.end)
        return self._count(self._index.keyframes_of.get(run_id, ()))

    def object_count(self, class_name: str | None = None) -> int:
        if class_name is None:
            return self._count(self._index.objects) - self._count(self._index.fused)
        return self._count(self._index.objects_of.get(class_name, ())) - self._count(
            self._index.fused_of.get(class_name, ())
        )

    def place_of(self, keyframe: str) -> str | None:
        ordinal = keyframe_ordinal(self._history, keyframe)
        if ordinal is None:
            return None
        return id_of_place(self._history, self._history.place_at(ordinal, self.end))

    def same_place(self, a: str, b: str) -> bool:
        place = self.place_of(a)
        return place is not None and place == self.place_of(b)

    def located_in(self, object_id: str) -> str | None:
        ordinal = self._history.object_ordinals.get(object_id)
        if ordinal is None or not self._history.objects[ordinal].stands(self.end):
            return None
        return id_of_place(self._history, self._history.object_at(ordinal, self.end).place)

    def sightings(self, object_id: str) -> int:
        ordinal = self._history.object_ordinals.get(object_id)
        if ordinal is None or not self._history.objects[ordinal].stands(self.end):
            return 0
        return self._history.object_at(ordinal, self.end).obs_count

    def size(self, place_id: str) -> int:
        ordinal = self._history.place_ordinals.get(place_id)
        if ordinal is None or not self._history.places[ordinal].stands(self.end):
            return 0
        change = self._history.places[ordinal].change(self.end)
        return 0 if change is None else change.keyframe_count

    def transitions(self, a: str, b: str) -> int:
        first, second = (self._history.place_ordinals.get(place) for place in (a, b))
        if first is None or second is None:
            return 0
        return self._history.transitions(first, second, self.end)

    def merged(self, place_id: str) -> bool:
        ordinal = self._history.place_ordinals.get(place_id)
        if ordinal is None:
            return False
        merge = self._history.places[ordinal].absorbed_by
        return merge is not None and merge.cause.offset < self.end

    def name(self, place_id: str) -> str | None:
        ordinal = self._history.place_ordinals.get(place_id)
        if ordinal is None or not self._history.places[ordinal].stands(self.end):
            return None
        return self._history.places[ordinal].name(self.end)

    def named(self, name: str) -> bool:
        return self.place_called(name) is not None

    def place_called(self, name: str) -> str | None:
        for place in self._index.places_called.get(name, ()):
            if place.stands(self.end) and place.name(self.end) == name:
                return place.place_id
        return None

    def refused_count(self) -> int:
        return self._count(self._index.refused)

    def has(self, kind: Names, text: str) -> bool:
        """Whether a thing of a kind has this name in the whole history."""
        if kind is Names.KEYFRAME:
            ordinal = keyframe_ordinal(self._history, text)
            return ordinal is not None and keyframe_name(self._history, ordinal) == text
        return text in self.names(kind)

    def names(self, kind: Names) -> Iterable[str]:
        """The names of all things of a kind in the whole history."""
        match kind:
            case Names.KEYFRAME:
                return (f"{k.run_id}:{k.keyframe_id}" for k in self._history.keyframes)
            case Names.PLACE:
                return self._history.place_ordinals.keys()
            case Names.OBJECT:
                return self._history.object_ordinals.keys()
            case Names.CLASS:
                return self._index.objects_of.keys()
            case Names.RUN:
                return self._index.keyframes_of.keys()
            case Names.NAME:
                return self._index.places_called.keys()

    def _count(self, offsets: Sequence[int]) -> int:
        return bisect_left(offsets, self.end)


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
