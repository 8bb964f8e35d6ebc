"""Oddities in the stamps of runs.

A robot counts its keyframes in the order in which it took them, so its stamps should grow with
their numbers, in whatever order they reached the log: one that was sent again late is no oddity.
Odd is a keyframe stamped before the one it follows (the robot's clock was set back), and one
stamped more than a day after it (a clock that was set while the robot drove: until then its stamps
were from another year). That stamps are far from when they were logged is not odd: runs are
imported long after, and robots have clocks of their own.
"""

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

JUMP_NS = 24 * 3600 * 1_000_000_000


class StampOddity(NamedTuple):
    """``offset`` of a keyframe and what is odd about its stamp."""

    offset: int
    message: str


@dataclass(slots=True)
class _Run:
    keyframes: "array[int]" = field(default_factory=lambda: array("q"))
    stamps: "array[int]" = field(default_factory=lambda: array("q"))
    offsets: "array[int]" = field(default_factory=lambda: array("q"))


class RunStamps:
    """Takes each keyframe once, in offset order; three numbers of memory for each."""

    def __init__(self) -> None:
        self._runs: dict[str, _Run] = {}

    def take(self, run_id: str, keyframe_id: int, stamp_ns: int, offset: int) -> None:
        """The next keyframe in the log."""
        run = self._runs.setdefault(run_id, _Run())
        run.keyframes.append(keyframe_id)
        run.stamps.append(stamp_ns)
        run.offsets.append(offset)

    def oddities(self) -> Iterator[StampOddity]:
        """What is odd, run by run in the order of keyframes."""
        for run_id, run in self._runs.items():
            order = sorted(range(len(run.keyframes)), key=run.keyframes.__getitem__)
            for before, this in pairwise(order):
                step_ns = run.stamps[this] - run.stamps[before]
                if step_ns < 0:
                    yield StampOddity(run.offsets[this], f"stamps of run {run_id} run backwards")
                elif step_ns > JUMP_NS:
                    yield StampOddity(
                        run.offsets[this], f"stamps of run {run_id} jump by more than a day"
                    )
