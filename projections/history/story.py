"""A chronicle: what happened to one thing, entry by entry, each with the event that caused it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from projections.deltas import KeyframeOrdinal, PlaceOrdinal, Pose

from .history import History
from .records import Cause


@dataclass(frozen=True, slots=True)
class Entry:
    """One thing that happened: ``what`` in a word, ``text`` as a sentence, ``facts`` for JSON."""

    cause: Cause
    what: str
    text: str
    facts: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        return {**self.cause.document(), "what": self.what, "text": self.text, **self.facts}


@dataclass(frozen=True, slots=True)
class Story:
    """The chronicle of ``subject``; ``summary`` says in a sentence or two how it stands now."""

    kind: str
    subject: str
    summary: str
    entries: tuple[Entry, ...]
    facts: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """JSON: the subject, its summary and facts, and every entry."""
        return {
            "kind": self.kind,
            "subject": self.subject,
            "summary": self.summary,
            **self.facts,
            "entries": [entry.document() for entry in self.entries],
        }


def keyframe_name(history: History, keyframe: KeyframeOrdinal) -> str:
    """``run_id:keyframe_id``."""
    added = history.keyframes[keyframe]
    return f"{added.run_id}:{added.keyframe_id}"


def place_name(history: History, place: PlaceOrdinal | None) -> str:
    """The place's id, or words for none."""
    return "no place" if place is None else history.places[place].place_id


def spot(pose: Pose | None) -> str:
    """Where a keyframe is, in metres."""
    if pose is None:
        return "no pose"
    return f"({pose.x_um / 1e6:.2f}, {pose.y_um / 1e6:.2f})"


def listed(names: Sequence[str]) -> str:
    """``a``, ``a and b``, ``a, b and c``."""
    return " and ".join(part for part in (", ".join(names[:-1]), names[-1]) if part)


def passed_mark(before: int, after: int) -> bool:
    """Whether a count passed one of 10, 20, 50, 100, 200, 500 …: the marks a chronicle keeps."""
    return _marks_up_to(after) > _marks_up_to(before)


def _marks_up_to(count: int) -> int:
    if count < 10:
        return 0
    digits = str(count)
    return 3 * (len(digits) - 2) + sum(digits[0] >= lead for lead in "125")
