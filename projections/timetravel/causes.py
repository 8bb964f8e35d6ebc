"""What made something happen: today always a keyframe, later also an operator's command.

Everything time travel reports carries a `Cause`, and nothing but this module looks at which kind it
is. A command on ``mapfold/command`` will be one more kind with a text of its own; the chronicle,
the diff and the merge table then name it without a change.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

from projections.deltas import Delta, KeyframeAdded

CauseKind = Literal["keyframe", "command"]


@dataclass(frozen=True, slots=True)
class Cause:
    """The event at ``offset`` and what it was.

    ``time_s`` is the robot's time in seconds, ``run_id`` and ``keyframe_id`` name the keyframe; all
    three are None for a cause that is not a keyframe. ``what`` is then its text.
    """

    offset: int
    kind: CauseKind
    time_s: float | None = None
    run_id: str | None = None
    keyframe_id: int | None = None
    what: str | None = None

    @property
    def name(self) -> str:
        """``run:keyframe``, or what a command said."""
        if self.kind == "keyframe":
            return f"{self.run_id}:{self.keyframe_id}"
        return self.what or f"{self.kind} at offset {self.offset}"

    @property
    def time(self) -> str | None:
        """The time as ISO 8601 in UTC."""
        return None if self.time_s is None else iso_time(self.time_s)

    @property
    def when(self) -> str:
        """Its time for people, its name where it has none."""
        return self.time or self.name

    @property
    def title(self) -> str:
        """Name and time, ``run:keyframe, 2026-03-24T13:00:00.000Z``."""
        return self.name if self.time is None else f"{self.name}, {self.time}"

    def document(self) -> dict[str, Any]:
        """The fields every JSON answer says a cause with."""
        return {
            "offset": self.offset,
            "time": self.time,
            "cause": self.kind,
            "run_id": self.run_id,
            "keyframe_id": self.keyframe_id,
        }


def cause_of(offset: int, deltas: Iterable[Delta]) -> Cause:
    """The cause of the deltas of one event: the keyframe it added, if it added one."""
    for delta in deltas:
        if isinstance(delta, KeyframeAdded):
            return Cause(offset, "keyframe", delta.timestamp, delta.run_id, delta.keyframe_id)
    return Cause(offset, "command")


def iso_time(time_s: float) -> str:
    """Robot seconds since the epoch as ISO 8601 UTC with milliseconds, ending in Z."""
    moment = datetime.fromtimestamp(time_s, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")
