"""The types an expression computes with."""

from enum import Enum
from typing import TypeAlias

Value: TypeAlias = int | str | bool | None


class Type(Enum):
    """What a node evaluates to; the value is how a message calls it."""

    NUMBER = "a number"
    TEXT = "a text or none"
    TRUTH = "true or false"


class Names(Enum):
    """What a text given to a function names; the value is how a message calls it."""

    KEYFRAME = "keyframe"
    PLACE = "place"
    OBJECT = "object"
    CLASS = "class"
    RUN = "run"
