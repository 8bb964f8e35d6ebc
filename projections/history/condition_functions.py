"""The functions that conditions can call, the types of their values, and how values can change.

The parser, ``bisect --help`` and the docs take them from one table, `FUNCTIONS`; the values come
from a map through `Facts`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Protocol, TypeAlias

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


class Facts(Protocol):
    """The values of the functions of conditions, for the map at one offset.

    Arguments are ids; a keyframe is ``run_id:keyframe_id``. For a thing that is not in the map
    (yet) the place is None and counts are 0.
    """

    def place_count(self) -> int:
        """Places that stand: formed and not absorbed."""

    def noise_count(self) -> int:
        """Keyframes with a pose that are in no place."""

    def keyframe_count(self, run_id: str | None = None) -> int:
        """Keyframes, of one run or of all, with or without a pose."""

    def object_count(self, class_name: str | None = None) -> int:
        """Objects, of one class or of all."""

    def place_of(self, keyframe: str) -> str | None:
        """The place a keyframe is in."""

    def located_in(self, object_id: str) -> str | None:
        """The place an object is in."""

    def sightings(self, object_id: str) -> int:
        """Observations fused into an object."""

    def size(self, place_id: str) -> int:
        """Keyframes in a place; 0 once it was absorbed."""

    def transitions(self, a: str, b: str) -> int:
        """Shared transitions of two places, in either order."""

    def merged(self, place_id: str) -> bool:
        """Whether a place was absorbed by another."""

    def name(self, place_id: str) -> str | None:
        """The name of a place; None once it was absorbed."""

    def place_called(self, name: str) -> str | None:
        """The place that stands and is called so, of several the one founded first."""

    def refused_count(self) -> int:
        """Merges that a command refused."""


@dataclass(frozen=True, slots=True)
class Function:
    """A function of a condition: what its arguments name, and the function that evaluates it."""

    name: str
    parameters: tuple[Names, ...]
    result: Type
    answer: Callable[..., Value]
    says: str
    optional: bool = False
    """Whether the one parameter may be left out."""
    rises: bool = False
    """Whether more events never lower it, or turn it from true to false."""

    @property
    def signature(self) -> str:
        """Name and parameters: ``object_count([class])``."""
        inner = ", ".join(p.value for p in self.parameters)
        return f"{self.name}([{inner}])" if self.optional else f"{self.name}({inner})"


def _same_place(facts: Facts, a: str, b: str) -> bool:
    place = facts.place_of(a)
    return place is not None and place == facts.place_of(b)


_KF, _PLACE, _OBJECT = Names.KEYFRAME, Names.PLACE, Names.OBJECT

_ALL = (
    Function(
        "place_count", (), Type.NUMBER, lambda f: f.place_count(), "places, without absorbed ones"
    ),
    Function(
        "noise_count", (), Type.NUMBER, lambda f: f.noise_count(), "posed keyframes in no place"
    ),
    Function(
        "keyframe_count",
        (Names.RUN,),
        Type.NUMBER,
        lambda f, run=None: f.keyframe_count(run),
        "keyframes, of one run or of all",
        optional=True,
        rises=True,
    ),
    Function(
        "object_count",
        (Names.CLASS,),
        Type.NUMBER,
        lambda f, name=None: f.object_count(name),
        "objects, of one class or of all",
        optional=True,
        rises=True,
    ),
    Function(
        "place_of", (_KF,), Type.TEXT, lambda f, k: f.place_of(k), "the place a keyframe is in"
    ),
    Function(
        "same_place",
        (_KF, _KF),
        Type.BOOLEAN,
        _same_place,
        "two keyframes are in one place",
        rises=True,
    ),
    Function(
        "located_in", (_OBJECT,), Type.TEXT, lambda f, o: f.located_in(o), "the place of an object"
    ),
    Function(
        "sightings",
        (_OBJECT,),
        Type.NUMBER,
        lambda f, o: f.sightings(o),
        "times an object was seen",
        rises=True,
    ),
    Function("size", (_PLACE,), Type.NUMBER, lambda f, p: f.size(p), "keyframes in a place"),
    Function(
        "transitions",
        (_PLACE, _PLACE),
        Type.NUMBER,
        lambda f, a, b: f.transitions(a, b),
        "shared transitions of two places",
    ),
    Function(
        "merged",
        (_PLACE,),
        Type.BOOLEAN,
        lambda f, p: f.merged(p),
        "a place was absorbed",
        rises=True,
    ),
    Function("name", (_PLACE,), Type.TEXT, lambda f, p: f.name(p), "the name of a place"),
    Function(
        "named",
        (Names.NAME,),
        Type.BOOLEAN,
        lambda f, n: f.place_called(n) is not None,
        "a place has this name",
    ),
    Function(
        "place_called",
        (Names.NAME,),
        Type.TEXT,
        lambda f, n: f.place_called(n),
        "the place of this name",
    ),
    Function(
        "refused_count",
        (),
        Type.NUMBER,
        lambda f: f.refused_count(),
        "merges that a command refused",
        rises=True,
    ),
)

FUNCTIONS: dict[str, Function] = {function.name: function for function in _ALL}


def functions_help() -> str:
    """One line per function, for ``--help`` and error messages."""
    return "\n".join(f"{f.signature:<34}{f.says}" for f in _ALL)
