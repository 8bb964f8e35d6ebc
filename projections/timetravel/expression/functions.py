"""The functions an expression may call: one table, read by the parser, the help and the docs."""

from collections.abc import Callable
from dataclasses import dataclass

from .facts import Facts
from .values import Names, Type, Value


@dataclass(frozen=True, slots=True)
class Function:
    """A question to the map: its name, what its texts name, and how it is answered."""

    name: str
    parameters: tuple[Names, ...]
    result: Type
    answer: Callable[..., Value]
    says: str
    optional: bool = False
    """Whether the one parameter may be left out."""
    rises: bool = False
    """Whether more events never lower it (nor turn it from true to false)."""

    @property
    def signature(self) -> str:
        """As a person writes it: ``object_count([class])``."""
        inner = ", ".join(p.value for p in self.parameters)
        return f"{self.name}([{inner}])" if self.optional else f"{self.name}({inner})"


def _same_place(facts: Facts, a: str, b: str) -> bool:
    place = facts.place_of(a)
    return place is not None and place == facts.place_of(b)


_KF, _PLACE, _OBJECT = Names.KEYFRAME, Names.PLACE, Names.OBJECT

_ALL = (
    Function("place_count", (), Type.NUMBER, lambda f: f.place_count(), "places that stand"),
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
        Type.TRUTH,
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
        "drives between two places",
    ),
    Function(
        "merged",
        (_PLACE,),
        Type.TRUTH,
        lambda f, p: f.merged(p),
        "a place was absorbed",
        rises=True,
    ),
)

FUNCTIONS: dict[str, Function] = {function.name: function for function in _ALL}


def functions_help() -> str:
    """One line per function, for ``--help`` and error messages."""
    return "\n".join(f"{f.signature:<34}{f.says}" for f in _ALL)
