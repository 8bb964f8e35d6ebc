"""The functions that conditions can call, the types of their values, and how values can change.

The parser, ``bisect --help`` and the docs take them from one table, `FUNCTIONS`; the values come
from `projections.history.bisect.HistoryFacts`.
"""

from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

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


@dataclass(frozen=True, slots=True)
class Function:
    """A function of a condition: what its arguments name, and the type of its value.

    The facts of a map have a method of its name. Of a thing that is not in the map (yet) the place
    is None and counts are 0.
    """

    name: str
    parameters: tuple[Names, ...]
    result: Type
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


_NUMBER, _TEXT, _BOOLEAN = Type.NUMBER, Type.TEXT, Type.BOOLEAN
_KF, _PLACE, _OBJECT, _NAME = Names.KEYFRAME, Names.PLACE, Names.OBJECT, Names.NAME
_ALL = (
    Function("place_count", (), _NUMBER, "places, without absorbed ones"),
    Function("noise_count", (), _NUMBER, "posed keyframes in no place"),
    Function(
        "keyframe_count", (Names.RUN,), _NUMBER, "keyframes, of one run or of all",
        optional=True, rises=True,
    ),
    Function(
        "object_count", (Names.CLASS,), _NUMBER, "objects, of one class or of all",
        optional=True, rises=True,
    ),
    Function("place_of", (_KF,), _TEXT, "the place a keyframe is in"),
    Function("same_place", (_KF, _KF), _BOOLEAN, "two keyframes are in one place", rises=True),
    Function("located_in", (_OBJECT,), _TEXT, "the place of an object"),
    Function("sightings", (_OBJECT,), _NUMBER, "times an object was seen", rises=True),
    Function("size", (_PLACE,), _NUMBER, "keyframes in a place"),
    Function("transitions", (_PLACE, _PLACE), _NUMBER, "shared transitions of two places"),
    Function("merged", (_PLACE,), _BOOLEAN, "a place was absorbed", rises=True),
    Function("name", (_PLACE,), _TEXT, "the name of a place"),
    Function("named", (_NAME,), _BOOLEAN, "a place has this name"),
    Function("place_called", (_NAME,), _TEXT, "the place of this name"),
    Function("refused_count", (), _NUMBER, "merges that a command refused", rises=True),
)  # fmt: skip

FUNCTIONS: dict[str, Function] = {function.name: function for function in _ALL}


def functions_help() -> str:
    """One line per function, for ``--help`` and error messages."""
    return "\n".join(f"{f.signature:<34}{f.says}" for f in _ALL)
