"""The shapes an expression is made of; every node knows its type and its column.

Three types, checked before anything is evaluated: a number, a text (an id, or ``none``) and a
truth. So a comparison that can never make sense is an error with a column, not a quiet false.
"""

from dataclasses import dataclass
from typing import TypeAlias

from .functions import Function
from .values import Type, Value


@dataclass(frozen=True, slots=True)
class Constant:
    """A number, a text or ``none`` as written."""

    column: int
    type: Type
    value: Value


@dataclass(frozen=True, slots=True)
class Call:
    """A function of the map."""

    column: int
    type: Type
    function: Function
    arguments: tuple[Constant, ...]


@dataclass(frozen=True, slots=True)
class Compare:
    """``left sign right``."""

    column: int
    sign: str
    left: "Node"
    right: "Node"
    type: Type = Type.TRUTH


@dataclass(frozen=True, slots=True)
class Not:
    """The opposite."""

    column: int
    operand: "Node"
    type: Type = Type.TRUTH


@dataclass(frozen=True, slots=True)
class Both:
    """``left and right``."""

    column: int
    left: "Node"
    right: "Node"
    type: Type = Type.TRUTH


@dataclass(frozen=True, slots=True)
class Either:
    """``left or right``."""

    column: int
    left: "Node"
    right: "Node"
    type: Type = Type.TRUTH


Node: TypeAlias = Constant | Call | Compare | Not | Both | Either
