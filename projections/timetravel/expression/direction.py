"""Which way an expression can turn as events are added to a map: what makes binary search right.

Some counts only ever rise (keyframes, objects), and some truths once true stay true (two keyframes
in one place). An expression built of those is monotone and can be searched; any other is scanned.
"""

from enum import Enum
from typing import assert_never

from .syntax import Both, Call, Compare, Constant, Either, Node, Not


class Direction(Enum):
    """How the value of an expression moves from the start of a log to its end."""

    STEADY = "never changes"
    RISING = "once true, stays true"
    FALLING = "once false, stays false"
    EITHER_WAY = "may turn both ways"


_OPPOSITE = {Direction.RISING: Direction.FALLING, Direction.FALLING: Direction.RISING}


def direction_of(node: Node) -> Direction:
    """The direction of a truth, or of a number that only grows (rising) or not."""
    match node:
        case Constant():
            return Direction.STEADY
        case Call(function=function):
            return Direction.RISING if function.rises else Direction.EITHER_WAY
        case Not(operand=operand):
            return _opposite(direction_of(operand))
        case Both(left=left, right=right) | Either(left=left, right=right):
            return _together(direction_of(left), direction_of(right))
        case Compare(sign=">" | ">=", left=left, right=right):
            return _together(direction_of(left), _opposite(direction_of(right)))
        case Compare(sign="<" | "<=", left=left, right=right):
            return _together(_opposite(direction_of(left)), direction_of(right))
        case Compare(left=left, right=right):
            steady = direction_of(left) is direction_of(right) is Direction.STEADY
            return Direction.STEADY if steady else Direction.EITHER_WAY
        case _:  # pragma: no cover
            assert_never(node)


def _opposite(direction: Direction) -> Direction:
    return _OPPOSITE.get(direction, direction)


def _together(first: Direction, second: Direction) -> Direction:
    if first is Direction.STEADY:
        return second
    if second is Direction.STEADY or second is first:
        return first
    return Direction.EITHER_WAY
