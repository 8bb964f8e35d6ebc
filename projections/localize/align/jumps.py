"""Frames that jump in the middle of a run: localisation was lost and set wrong.

A jump shows as a step that is faster or longer than the robot's steps ever are. The stretch from
there to the next such step is mapped alone and aligned to the map of everything else in the log. It
jumped if it then comes to lie elsewhere, and if that makes the step one that the robot may have
driven. A run's first stretch is taken to be right, for its frame is that in which the run began.
"""

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from eventsrc.envelope.commands import RigidTransform
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from eventsrc.log import LogReader
from projections.fold.corrections import Corrections
from projections.fold.deltas import Pose
from projections.fold.pose_corrections import PoseCorrection, PoseCorrections
from projections.fold.settings import Settings
from projections.map.records import KeyframeRecord
from projections.map.view import MapView

from .alignment import Alignment, align
from .framed_things import FramedThings, map_of_runs, things_of_map
from .matching import Floats, Tie

_USUALLY_PERCENT, _MORE_THAN_USUAL = 98, 2.5
_LEAST_STEP_M, _LEAST_S = 1.0, 0.1
_LEAST_USUAL: Final = 0.01
"""Of a parked robot's steps and speeds, in m and m/s."""
_MOST_STEPS: Final = 3
"""The most steps of a run that are looked into, the largest ones."""
_LEAST_KEYFRAMES: Final = 10
_LEAST_SHIFT_M: Final = 1.5
_LEAST_TURN_RAD: Final = 0.35
_SPARE_M: Final = 1.0
_LEAST_SHARE: Final = 0.6
"""Of what should be seen again: within a run more of it is than on another day, and in a look-alike
room next door less."""
_SPARE_TIE_M, _SPARE_TIE_RAD = 0.3, 0.2
"""What the pose behind a step may be off beside what is usual, standard errors."""
Ranges = tuple[tuple[KeyframeId, KeyframeId], ...]
_FIRST, _LAST = KeyframeId(-(2**63)), KeyframeId(2**63 - 1)


class Stretch(NamedTuple):
    """Keyframes of a run from ``first`` to ``last``, both included; None: to its end."""

    first: KeyframeId
    last: KeyframeId | None

    def has(self, keyframe_id: KeyframeId) -> bool:
        """Whether a keyframe is in it."""
        return self.first <= keyframe_id and (self.last is None or keyframe_id <= self.last)

    @property
    def inside(self) -> Ranges:
        """Its keyframes."""
        return ((self.first, _LAST if self.last is None else self.last),)

    @property
    def outside(self) -> Ranges:
        """The run's other keyframes."""
        before = (_FIRST, KeyframeId(self.first - 1))
        return (before,) if self.last is None else (before, (KeyframeId(self.last + 1), _LAST))


class LargeStep(NamedTuple):
    """A step too large to be driven, of ``step_m`` metres, and the stretch behind it. ``found`` is
    the stretch's transform into the frame of everything else, None where there is nothing to
    compare; ``is_jump``: it explains the step."""

    stretch: Stretch
    step_m: float
    found: Alignment | None
    is_jump: bool


class _Step(NamedTuple):
    """The step to a keyframe, ``to``: its length, and the longest way and the widest turn that are
    usual in its time."""

    to: int
    step_m: float
    usual_m: float
    usual_rad: float


Things = Callable[[Stretch], FramedThings | None]


def jumps_of_run(
    reader: LogReader,
    end: Offset,
    corrections: Corrections,
    settings: Settings,
    view: MapView,
    run: RunId,
) -> Iterator[LargeStep]:
    """The large steps of a run of a log, whose map is ``view``."""
    others = {each.run_id for each in view.runs} - {run}
    keyframes = [each for each in view.keyframes if each.run_id == run]
    in_frame: Corrections | None = None

    def map_of(
        known: Corrections, without: Collection[RunId], ranges: Mapping[RunId, Ranges]
    ) -> FramedThings | None:
        return things_of_map(map_of_runs(reader, end, known, settings, without, ranges))

    def everything_else(stretch: Stretch) -> FramedThings | None:
        nonlocal in_frame
        if in_frame is None:
            in_frame = corrections
            begin = map_of(corrections, others, {run: Stretch(stretch.first, None).inside})
            rest = map_of(corrections, {run}, {}) if others else None
            if begin is not None and rest is not None:
                in_frame = _moved(corrections, others, align(begin, rest))
        return map_of(in_frame, (), {run: stretch.inside})

    return find_jumps(
        keyframes,
        lambda stretch: map_of(corrections, others, {run: stretch.outside}),
        everything_else,
    )


def _moved(
    corrections: Corrections, runs: Collection[RunId], found: Alignment | None
) -> Corrections:
    """With these runs in the frame that was found for them, if it is another one for sure."""
    if found is None or found.verdict != "sure" or found.is_one_frame:
        return corrections
    x, y, angle = found.transform
    cos, sin = math.cos(angle), math.sin(angle)
    by = RigidTransform(dx=x, dy=y, dyaw=angle, cos=cos, sin=sin)
    poses = dict(corrections.poses)
    for each in runs:
        poses[each] = PoseCorrections((*poses.get(each, ()), PoseCorrection({}, by, None, None)))
    return msgspec.structs.replace(corrections, poses=poses)


def find_jumps(
    keyframes: Sequence[KeyframeRecord], alone: Things, everything_else: Things
) -> Iterator[LargeStep]:
    """The large steps of a run, by its keyframes. ``alone`` maps a stretch of it,
    ``everything_else`` the log without it; None where there is nothing to compare."""
    known = [(k.keyframe_id, k.timestamp, k.pose) for k in keyframes if k.pose is not None]
    known.sort(key=lambda each: each[0])
    ids = [each[0] for each in known]
    poses = [each[2] for each in known]
    steps = _large_steps([each[1] for each in known], poses)
    for number, step in enumerate(steps, start=1):
        end = steps[number].to if number < len(steps) else len(known)
        stretch = Stretch(ids[step.to], None if end == len(known) else ids[end - 1])
        first = second = None
        if min(step.to, end - step.to) >= _LEAST_KEYFRAMES:
            first, second = everything_else(stretch), alone(stretch)
        before, after = (_row(poses[number]) for number in (step.to - 1, step.to))
        tie = Tie(after, before, step.usual_m + _SPARE_TIE_M, step.usual_rad + _SPARE_TIE_RAD)
        found = None if first is None or second is None else align(first, second, tie)
        is_jump = found is not None and _explains(found, step, tie)
        yield LargeStep(stretch, step.step_m, found, is_jump)


def _large_steps(stamps: Sequence[float], poses: Sequence[Pose]) -> list[_Step]:
    """The steps that are much longer or faster than is usual, by keyframe. What is usual does not
    depend on the `_MOST_STEPS` largest, which may be jumps."""
    if len(poses) < 2 * _LEAST_KEYFRAMES:
        return []
    at: Floats = np.array([_row(pose) for pose in poses])
    lengths = np.hypot(*np.diff(at[:, :2], axis=0).T)
    turns = np.abs((np.diff(at[:, 2]) + math.pi) % math.tau - math.pi)
    seconds = np.maximum(np.diff(stamps), _LEAST_S)
    usual, usual_speed, usual_turn = (
        max(
            _LEAST_USUAL,
            min(np.percentile(each, _USUALLY_PERCENT), np.sort(each)[-_MOST_STEPS - 1]),
        )
        for each in (lengths, lengths / seconds, turns)
    )
    longest = np.maximum(usual, usual_speed * seconds)
    widest = np.minimum(usual_turn * np.maximum(seconds / np.median(seconds), 1.0), math.pi)
    excess = np.maximum(lengths / usual, lengths / seconds / usual_speed)
    is_large = (lengths > _LEAST_STEP_M) & (excess > _MORE_THAN_USUAL)
    found = sorted(np.flatnonzero(is_large).tolist(), key=lambda i: (-excess[i], i))[:_MOST_STEPS]
    return [
        _Step(i + 1, float(lengths[i]), float(longest[i]), float(widest[i])) for i in sorted(found)
    ]


def _row(pose: Pose) -> Floats:
    return np.array((pose.x_m, pose.y_m, pose.yaw_rad))


def _explains(found: Alignment, step: _Step, tie: Tie) -> bool:
    """Whether a stretch lies elsewhere and the step to it becomes one that may be driven."""
    is_elsewhere = (
        found.shift_m > _LEAST_SHIFT_M
        or abs(math.remainder(found.transform[2], math.tau)) > _LEAST_TURN_RAD
    )
    step_m, _ = tie.apart(found.transform)
    may_be = step.usual_m + _SPARE_M + 3.0 * found.se_m
    is_told = found.verdict != "unknown" and found.matched >= _LEAST_SHARE * found.expected
    return is_told and is_elsewhere and step_m < may_be and step_m < step.step_m
