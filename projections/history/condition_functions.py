"""The functions that conditions can call, the types of their values, and how values can change.

The parser, ``bisect --help`` and the docs take them from one table, `FUNCTIONS`; the values come
from `HistoryFacts`.
"""

from array import array
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from enum import Enum
from typing import Any, TypeAlias

import numpy as np

from eventsrc.envelope.model import Offset
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.store.history import NEVER, History
from projections.store.history_records import ObjectHistory, PlaceHistory

from .names import id_of_place, keyframe_name, keyframe_ordinal

Value: TypeAlias = int | str | bool | None


class Type(Enum):
    """The type of a part of a condition; the value is its name in messages."""

    NUMBER = "a number"
    TEXT = "a text or none"
    BOOLEAN = "true or false"


class Names(Enum):
    """The kind of thing that a text argument names; the value is its name in messages."""

    KEYFRAME = "keyframe"
    PLACE = "place"
    OBJECT = "object"
    CLASS = "class"
    RUN = "run"
    NAME = "name"


@dataclass(frozen=True, slots=True)
class Mention:
    """A name in a condition, such as keyframe ``house-a:12``, what it names, and its column."""

    kind: Names
    text: str
    column: int


class Direction(Enum):
    """How a value can change as events are added: binary search is for rising conditions only."""

    STEADY = "never changes"
    RISING = "once true, stays true"
    FALLING = "once false, stays false"
    EITHER_WAY = "may turn both ways"

    @property
    def opposite(self) -> "Direction":
        """The direction of ``not`` this."""
        return {Direction.RISING: Direction.FALLING, Direction.FALLING: Direction.RISING}.get(
            self, self
        )

    def joined(self, other: "Direction") -> "Direction":
        """The direction of a value that rises when either rises."""
        if Direction.STEADY in (self, other):
            return self if other is Direction.STEADY else other
        return self if self is other else Direction.EITHER_WAY

    def compared(self, sign: str, other: "Direction") -> "Direction":
        """The direction of a comparison of two values by ``sign``."""
        if sign in (">", ">="):
            return self.joined(other.opposite)
        if sign in ("<", "<="):
            return self.opposite.joined(other)
        return self if self is other is Direction.STEADY else Direction.EITHER_WAY


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
    history; ``end`` may be assigned. A keyframe is ``run_id:keyframe_id``; ``ids`` has the ids of
    the places and objects that a condition calls otherwise."""

    def __init__(self, history: History, index: CountIndex, end: Offset) -> None:
        self._history = history
        self._index = index
        self.end = end
        self.ids: dict[tuple[Names, str], str] = {}

    def id_of(self, kind: Names, text: str) -> str:
        """The id of the thing of this kind that a condition calls so."""
        return self.ids.get((kind, text), text)

    def _place(self, text: str) -> PlaceOrdinal | None:
        return self._history.place_ordinals.get(self.id_of(Names.PLACE, text))

    def _object(self, text: str) -> ObjectOrdinal | None:
        return self._history.object_ordinals.get(self.id_of(Names.OBJECT, text))

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
        ordinal = self._object(object_id)
        if ordinal is None or not self._history.objects[ordinal].stands(self.end):
            return None
        return id_of_place(self._history, self._history.object_at(ordinal, self.end).place)

    def sightings(self, object_id: str) -> int:
        ordinal = self._object(object_id)
        if ordinal is None or not self._history.objects[ordinal].stands(self.end):
            return 0
        return self._history.object_at(ordinal, self.end).obs_count

    def size(self, place_id: str) -> int:
        ordinal = self._place(place_id)
        if ordinal is None or not self._history.places[ordinal].stands(self.end):
            return 0
        change = self._history.places[ordinal].change(self.end)
        return 0 if change is None else change.keyframe_count

    def transitions(self, a: str, b: str) -> int:
        first, second = map(self._place, (a, b))
        if first is None or second is None:
            return 0
        return self._history.transitions(first, second, self.end)

    def merged(self, place_id: str) -> bool:
        ordinal = self._place(place_id)
        if ordinal is None:
            return False
        merge = self._history.places[ordinal].absorbed_by
        return merge is not None and merge.cause.offset < self.end

    def name(self, place_id: str) -> str | None:
        ordinal = self._place(place_id)
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


@dataclass(frozen=True, slots=True)
class Function:
    """A function of a condition: the method that gives its value, looked up by name in the facts,
    what its arguments name, and the type of its value.

    Of a thing that is not in the map (yet) the place is None and counts are 0.
    """

    method: Callable[..., Value]
    parameters: tuple[Names, ...]
    result: Type
    says: str
    optional: bool = False
    """Whether the one parameter may be left out."""
    rises: bool = False
    """Whether more events never lower it, or turn it from true to false."""
    gives_place: bool = False
    """Whether its value is the id of a place."""

    @property
    def name(self) -> str:
        """That of the method."""
        return self.method.__name__

    @property
    def signature(self) -> str:
        """Name and parameters: ``object_count([class])``."""
        inner = ", ".join(p.value for p in self.parameters)
        return f"{self.name}([{inner}])" if self.optional else f"{self.name}({inner})"


_NUMBER, _TEXT, _BOOLEAN = Type.NUMBER, Type.TEXT, Type.BOOLEAN
_KF, _PLACE, _OBJECT, _NAME = Names.KEYFRAME, Names.PLACE, Names.OBJECT, Names.NAME
_ALL = (
    Function(HistoryFacts.place_count, (), _NUMBER, "places, without absorbed ones"),
    Function(HistoryFacts.noise_count, (), _NUMBER, "posed keyframes in no place"),
    Function(
        HistoryFacts.keyframe_count, (Names.RUN,), _NUMBER, "keyframes, of one run or of all",
        optional=True, rises=True,
    ),
    Function(
        HistoryFacts.object_count, (Names.CLASS,), _NUMBER, "objects, of one class or of all",
        optional=True, rises=True,
    ),
    Function(
        HistoryFacts.place_of, (_KF,), _TEXT, "the place a keyframe is in", gives_place=True
    ),
    Function(
        HistoryFacts.same_place, (_KF, _KF), _BOOLEAN, "two keyframes are in one place", rises=True
    ),
    Function(
        HistoryFacts.located_in, (_OBJECT,), _TEXT, "the place of an object", gives_place=True
    ),
    Function(HistoryFacts.sightings, (_OBJECT,), _NUMBER, "times an object was seen", rises=True),
    Function(HistoryFacts.size, (_PLACE,), _NUMBER, "keyframes in a place"),
    Function(
        HistoryFacts.transitions, (_PLACE, _PLACE), _NUMBER, "shared transitions of two places"
    ),
    Function(HistoryFacts.merged, (_PLACE,), _BOOLEAN, "a place was absorbed", rises=True),
    Function(HistoryFacts.name, (_PLACE,), _TEXT, "the name of a place"),
    Function(HistoryFacts.named, (_NAME,), _BOOLEAN, "a place has this name"),
    Function(
        HistoryFacts.place_called, (_NAME,), _TEXT, "the place of this name", gives_place=True
    ),
    Function(HistoryFacts.refused_count, (), _NUMBER, "merges that a command refused", rises=True),
)  # fmt: skip

FUNCTIONS: dict[str, Function] = {function.name: function for function in _ALL}


def no_function(name: str) -> str:
    """What is wrong with a name that no function has, and what could be meant."""
    near = get_close_matches(name.lower(), FUNCTIONS, n=1)
    if near:
        return f"no function {name!r}; did you mean {near[0]!r}?"
    return f"no function {name!r}; there are {', '.join(sorted(FUNCTIONS))}"


def functions_help() -> str:
    """One line per function, for ``--help`` and error messages."""
    return "\n".join(f"{f.signature:<34}{f.says}" for f in _ALL)
