"""The map frames of a map, besides its own: those that a command joined, and those held apart."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from eventsrc.base.text import counted, table, visible
from eventsrc.envelope.model import RunId
from projections.fold.deltas import FrameJoined

from .view import MapView


@dataclass(frozen=True, slots=True)
class MapFrame:
    """A frame that ``keyframes`` keyframes of ``runs`` name; ``joined`` is None while it is held
    apart."""

    frame: str
    joined: FrameJoined | None
    runs: list[RunId] = field(default_factory=list)
    keyframes: int = 0

    def document(self) -> dict[str, Any]:
        """The frame as JSON."""
        found: dict[str, Any] = {"frame": self.frame, "held_apart": self.joined is None}
        found |= {"runs": self.runs, "keyframes": self.keyframes}
        if (by := self.joined) is not None:
            moves = {"dx": by.dx, "dy": by.dy, "dyaw_rad": by.dyaw}
            found |= {"into": by.into, **moves, "command": by.command, "offset": by.offset}
        return found

    @property
    def state(self) -> str:
        """``held apart``, or the frame that it is part of."""
        if self.joined is None:
            return "held apart"
        into = self.joined.into
        return "joined to the map" if into is None else f"joined to {visible(into)}"


def frames_of(view: MapView) -> list[MapFrame]:
    """The frames in the order of their first keyframes."""
    counts: dict[str, dict[RunId, int]] = {}
    for keyframe in view.keyframes if view.frames or view.floors else ():
        if keyframe.frame is not None:
            runs = counts.setdefault(keyframe.frame, {})
            runs[keyframe.run_id] = runs.get(keyframe.run_id, 0) + 1
    return [
        MapFrame(frame, view.frames.get(frame), list(runs), sum(runs.values()))
        for frame, runs in counts.items()
    ]


def frames_text(frames: Iterable[MapFrame]) -> str:
    """A table of frames."""
    heads = ("frame", "state", "keyframes", "runs", "dx", "dy", "dyaw", "command")
    rows = []
    for each in frames:
        by = each.joined
        moves = (
            [""] * 4
            if by is None
            else [f"{by.dx:.2f}", f"{by.dy:.2f}", f"{by.dyaw:.3f}", f"{by.command:,}"]
        )
        named = [visible(each.frame), each.state, f"{each.keyframes:,}"]
        rows.append([*named, ", ".join(map(visible, each.runs)), *moves])
    if not rows:
        return "all keyframes are in one frame\n"
    return table(heads, rows, right=("keyframes", *heads[4:]))


def frames_line(frames: Iterable[MapFrame]) -> str:
    """One line: ``b (20 keyframes) held apart, c (7 keyframes) joined to the map``."""
    return ", ".join(
        f"{visible(each.frame)} ({counted(each.keyframes, 'keyframe')}) {each.state}"
        for each in frames
    )
