"""The choice of the topics of a file to import, and counts of messages passed over."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from fnmatch import translate
from typing import Final

from pydantic_core import from_json

from eventsrc.base.errors import MisuseError

NOT_CHOSEN: Final = "not chosen"
NO_ENVELOPES: Final = "json, no envelopes"
_FIELDS: Final = ("run_id", "keyframe_id", "timestamp", "detections")
_ENOUGH_FIELDS: Final = 2
_CLASS_FIELDS: Final = ("class", "class_name")


@dataclass(frozen=True)
class TopicChoice:
    """The topics that match one of the shell patterns ``patterns``; all topics if there is none.
    ``*`` matches any characters, also ``/``."""

    patterns: tuple[str, ...] = ()
    _expressions: list[re.Pattern[str]] = field(default_factory=list, compare=False)

    @classmethod
    def of(cls, patterns: Sequence[str]) -> "TopicChoice":
        """The choice by these patterns. Raises MisuseError for an empty one."""
        if not all(patterns):
            raise MisuseError("--topic is empty; give a topic, or a pattern such as 'tb/*'")
        return cls(tuple(patterns), [re.compile(translate(pattern)) for pattern in patterns])

    def __bool__(self) -> bool:
        return bool(self.patterns)

    def takes(self, topic: str) -> bool:
        """Whether messages of ``topic`` are imported."""
        return not self._expressions or any(e.match(topic) for e in self._expressions)


@dataclass(frozen=True, slots=True)
class PassedOver:
    """The number of messages of one topic that were not imported. ``what`` is their encoding and
    schema, `NO_ENVELOPES` or `NOT_CHOSEN`."""

    topic: str
    what: str
    count: int


def looks_like_envelope(payload: bytes) -> bool:
    """Whether an invalid payload has enough fields of an envelope to be kept as rejected. True also
    for text that is no JSON, because it may be a torn envelope."""
    try:
        value = from_json(payload)
    except (ValueError, RecursionError):
        return True
    if isinstance(value, dict):
        return sum(name in value for name in _FIELDS) >= _ENOUGH_FIELDS
    if not isinstance(value, list) or not all(isinstance(each, dict) for each in value):
        return False
    return all(any(name in each for name in _CLASS_FIELDS) for each in value)
