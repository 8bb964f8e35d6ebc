"""Asking a map whether an expression holds."""

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, assert_never

from .direction import Direction, direction_of
from .errors import ExpressionError
from .facts import Facts
from .parser import parse
from .syntax import Both, Call, Compare, Constant, Either, Node, Not
from .values import Names, Value

_SIGNS: dict[str, Callable[[Any, Any], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    "==": operator.eq,
    "!=": operator.ne,
    ">=": operator.ge,
    ">": operator.gt,
}


@dataclass(frozen=True, slots=True)
class Mention:
    """A thing an expression names, such as keyframe ``house-a:12``, and where it names it."""

    kind: Names
    text: str
    column: int


class Expression:
    """A condition over the map, read once, asked often. Raises ExpressionError when unreadable."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._root = parse(source)

    def __str__(self) -> str:
        return self.source

    def holds(self, facts: Facts) -> bool:
        """Whether it is true of this map."""
        return bool(_value(self._root, facts))

    def readings(self, facts: Facts) -> tuple[tuple[str, Value], ...]:
        """Every function it calls as written, with its value: why it holds or not."""
        seen = {self._text(call): _value(call, facts) for call in _calls(self._root)}
        return tuple(seen.items())

    @property
    def direction(self) -> Direction:
        """Which way it can turn as events are added."""
        return direction_of(self._root)

    def mentions(self) -> tuple[Mention, ...]:
        """The keyframes, places, objects, classes and runs it names."""
        return tuple(
            Mention(kind, str(argument.value), argument.column)
            for call in _calls(self._root)
            for kind, argument in zip(call.function.parameters, call.arguments, strict=False)
        )

    def error_at(self, column: int, reason: str) -> ExpressionError:
        """An error that points into this expression."""
        return ExpressionError(self.source, column, reason)

    def _text(self, call: Call) -> str:
        if not call.arguments:
            return call.function.name
        return f"{call.function.name}({', '.join(repr(a.value) for a in call.arguments)})"


def _value(node: Node, facts: Facts) -> Value:
    match node:
        case Constant(value=value):
            return value
        case Call(function=function, arguments=arguments):
            return function.answer(facts, *(a.value for a in arguments))
        case Compare(sign=sign, left=left, right=right):
            return _SIGNS[sign](_value(left, facts), _value(right, facts))
        case Not(operand=operand):
            return not _value(operand, facts)
        case Both(left=left, right=right):
            return bool(_value(left, facts)) and bool(_value(right, facts))
        case Either(left=left, right=right):
            return bool(_value(left, facts)) or bool(_value(right, facts))
        case _:  # pragma: no cover
            assert_never(node)


def _calls(node: Node) -> Iterator[Call]:
    match node:
        case Constant():
            return
        case Call():
            yield node
        case Not(operand=operand):
            yield from _calls(operand)
        case (
            Compare(left=left, right=right)
            | Both(left=left, right=right)
            | Either(left=left, right=right)
        ):
            yield from _calls(left)
            yield from _calls(right)
        case _:  # pragma: no cover
            assert_never(node)
