"""The command ``correct-poses``: a rigid transform, or a trajectory laid over a run.

By keyframe id a keyframe takes the pose with its id. By stamp it takes the pose at its timestamp:
x and y linearly between the two poses around it, yaw the shorter way round. Nothing is
extrapolated: a keyframe before the first or after the last pose takes that one if it is within
``slack_s`` of it, and otherwise stays as it is.
"""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope import commands
from eventsrc.envelope.commands import MAX_COMMAND_BYTES
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import MAX_POSITION_M, KeyframeId, Offset, RunId
from eventsrc.envelope.trajectory import Trajectory, TrajectoryPose
from eventsrc.log import LogReader
from projections.fold.corrections import FrameJoin
from projections.fold.pose_corrections import Pose, moved_by
from projections.map.frames import frames_of
from projections.map.parsing import parse_events
from projections.map.records import KeyframeRecord
from projections.map.view import MapView

from .conflicts import check_run_in_map
from .current import MapToEdit
from .make import Stamp, build, keyframes_of

DEFAULT_SLACK_S = 0.05


class RunKeyframe(NamedTuple):
    """A keyframe of the run, ``timestamp`` in seconds."""

    keyframe_id: KeyframeId
    timestamp: float


class Laid(NamedTuple):
    """``poses`` in the order of the keyframes; ``left`` are keyframes that stay as they are;
    ``unknown`` are poses of keyframes that the run does not have; ``widest_s`` is the longest time
    between two poses that was interpolated over."""

    poses: tuple[commands.CorrectedPose, ...]
    left: tuple[KeyframeId, ...]
    unknown: tuple[TrajectoryPose, ...]
    widest_s: float


def lay(
    trajectory: Trajectory, keyframes: Iterable[RunKeyframe], slack_s: float = DEFAULT_SLACK_S
) -> Laid:
    """The corrected poses of the keyframes of a run."""
    if trajectory.by == "keyframe":
        return _by_keyframe(trajectory, list(keyframes))
    stamps = [pose.key for pose in trajectory.poses]
    poses, left, widest = [], [], 0.0
    for keyframe_id, timestamp in keyframes:
        found = _pose_at(trajectory.poses, stamps, timestamp, slack_s)
        if found is None:
            left.append(keyframe_id)
            continue
        (x, y, yaw), width = found
        widest = max(widest, width)
        poses.append(commands.CorrectedPose(keyframe_id=keyframe_id, x=x, y=y, yaw=yaw))
    return Laid(tuple(poses), tuple(left), (), widest)


def _by_keyframe(trajectory: Trajectory, keyframes: Sequence[RunKeyframe]) -> Laid:
    given = {KeyframeId(int(pose.key)): pose for pose in trajectory.poses}
    poses = [
        commands.CorrectedPose(keyframe_id=k.keyframe_id, x=pose.x, y=pose.y, yaw=pose.yaw)
        for k in keyframes
        if (pose := given.get(k.keyframe_id)) is not None
    ]
    left = tuple(k.keyframe_id for k in keyframes if k.keyframe_id not in given)
    there = {k.keyframe_id for k in keyframes}
    unknown = tuple(pose for id_, pose in given.items() if id_ not in there)
    return Laid(tuple(poses), left, unknown, 0.0)


def _pose_at(
    poses: Sequence[TrajectoryPose], stamps: Sequence[float], at: float, slack_s: float
) -> tuple[tuple[float, float, float], float] | None:
    """The pose at a time, and the time between the poses around it; None outside."""
    index = bisect_left(stamps, at)
    if index < len(poses) and stamps[index] == at:
        return _values(poses[index]), 0.0
    if index == 0:
        return (_values(poses[0]), 0.0) if stamps[0] - at <= slack_s else None
    if index == len(poses):
        return (_values(poses[-1]), 0.0) if at - stamps[-1] <= slack_s else None
    before, after = poses[index - 1], poses[index]
    width = after.key - before.key
    part = (at - before.key) / width
    turn = math.remainder(after.yaw - before.yaw, math.tau)
    pose = (
        before.x + part * (after.x - before.x),
        before.y + part * (after.y - before.y),
        math.remainder(before.yaw + part * turn, math.tau),
    )
    return pose, width


def _values(pose: TrajectoryPose) -> tuple[float, float, float]:
    return pose.x, pose.y, pose.yaw


_MOST_NAMED = 5


class Span(NamedTuple):
    """Keyframes from ``first`` to ``last``, both included; None for no bound."""

    first: KeyframeId | None
    last: KeyframeId | None

    def has(self, keyframe_id: KeyframeId) -> bool:
        """Whether a keyframe is in it."""
        after = self.first is None or self.first <= keyframe_id
        return after and (self.last is None or keyframe_id <= self.last)


def by_trajectory(
    current: MapToEdit,
    stamp: Stamp,
    run_id: str,
    trajectory: Trajectory,
    span: Span,
    slack_s: float,
    *,
    ignore_missing: bool = False,
    note: Callable[[str], None] = lambda _: None,
) -> commands.CorrectPoses:
    """The poses of a file, in the run's own frame, for its keyframes. ``note`` is called with a
    message if the file may be cut off, keyframes or poses are left out, or poses are interpolated.
    """
    keyframes = _keyframes(current, run_id, span)
    laid = lay(trajectory, keyframes, slack_s)
    in_run = {k.keyframe_id for k in current.run(run_id)}
    laid = laid._replace(unknown=tuple(p for p in laid.unknown if p.key not in in_run))
    if laid.unknown and not ignore_missing:
        _refuse_unknown(current, run_id, trajectory, laid)
    if not laid.poses:
        raise MisuseError(_nothing_laid(trajectory, keyframes, slack_s))
    _note_left(note, run_id, trajectory, laid, slack_s)
    joined = current.corrections.frames.keys() & {k.frame for k in current.run(run_id)}
    if joined:
        names = ", ".join(visible(str(frame)) for frame in sorted(joined))
        note(f"{trajectory.name}: read as poses in frame {names}, which join-frames moves then")
    command = build(commands.CorrectPoses, stamp, run_id=run_id, poses=laid.poses)
    size = len(commands.encode_command(command))
    if size > MAX_COMMAND_BYTES:
        raise MisuseError(
            f"{trajectory.name}: {counted(len(laid.poses), 'pose')} make a command of {size:,}"
            f" bytes, more than {MAX_COMMAND_BYTES:,}; give it in parts with --from and"
            " --to"
        )
    return command


def by_transform(
    current: MapToEdit, stamp: Stamp, run_id: str, span: Span, dx: float, dy: float, dyaw: float
) -> commands.CorrectPoses:
    """One rigid transform of the keyframes of a run. The command has it in the run's own frame,
    which joins of frames move after it."""
    transform = _transform(dx, dy, dyaw)
    _keyframes(current, run_id, span)
    if joins := _joins_of(current, run_id, span):
        here: Pose = (0.0, 0.0, 0.0)
        for join in joins:
            here = moved_by(join.transform, here)
        there = moved_by(transform, here)
        x, y, angle = there[0] - here[0], there[1] - here[1], here[2]
        cos, sin = math.cos(angle), math.sin(angle)
        transform = _transform(cos * x + sin * y, cos * y - sin * x, dyaw)
    return build(
        commands.CorrectPoses,
        stamp,
        run_id=run_id,
        transform=transform,
        first=span.first,
        last=span.last,
    )


def _joins_of(current: MapToEdit, run_id: str, span: Span) -> list[FrameJoin]:
    """The joins that move the keyframes of a run after their correction. Raises MisuseError if
    these are not the same for all."""
    frames = {
        k.frame for k in current.run(run_id) if k.pose is not None and span.has(k.keyframe_id)
    }
    joins = [current.corrections.frame_joins(frame) for frame in sorted(frames, key=str)]
    if any(each != joins[0] for each in joins):
        named = ", ".join(visible(frame or "the map's own") for frame in sorted(frames, key=str))
        raise MisuseError(
            f"{visible(run_id)} has keyframes in several frames, {named}; correct those of one with"
            " --from and --to"
        )
    return joins[0] if joins else []


def _own_frame(reader: LogReader, view: MapView) -> str | None:
    """The name of the map's own frame, which is that of its first pose; None if it has none."""
    first = next((each for each in view.keyframes if each.pose is not None), None)
    if first is None:
        return None
    if joins := view.corrections.frame_joins(first.frame):
        return joins[-1].into
    (event,) = parse_events(list(reader.read(first.offset, Offset(first.offset + 1))))
    return event.parsed.envelope.frame if isinstance(event.parsed, Accepted) else None


def _frames(reader: LogReader, view: MapView) -> Iterator[tuple[KeyframeRecord, str | None]]:
    """Each keyframe with a pose, and the frame that it is in after all joins."""
    own = _own_frame(reader, view)
    for keyframe in view.keyframes:
        if keyframe.pose is not None:
            joins = view.corrections.frame_joins(keyframe.frame)
            frame = joins[-1].into if joins else keyframe.frame
            yield keyframe, None if frame == own else frame


def frames_of_runs(reader: LogReader, view: MapView) -> dict[RunId, set[str | None]]:
    """The frames that the poses of each run are in after all joins: None is the map's own, the
    others are held apart."""
    found = dict[RunId, set[str | None]]()
    for keyframe, frame in _frames(reader, view):
        found.setdefault(keyframe.run_id, set()).add(frame)
    return found


def join_frames(
    current: MapToEdit,
    stamp: Stamp,
    frame: str,
    into: str | None,
    dx: float,
    dy: float,
    dyaw: float,
) -> commands.JoinFrames:
    """One rigid transform of all keyframes in the map frame ``frame`` into the frame ``into``, None
    for the map's own. Raises MisuseError for a frame that is not held apart."""
    there, own = frames_of(current.view), _own_frame(current.reader, current.view)
    apart = [each.frame for each in there if each.joined is None]
    names = f"held apart are {', '.join(map(visible, apart))}" if apart else "none is held apart"
    # By its name, so that it stays that one where the first run in it is left out.
    into = own if into is None else into
    for given in (frame, into):
        if given is not None and given not in apart and (given is frame or given != own):
            joined = any(each.frame == given for each in there)
            raise MisuseError(
                f"frame {visible(given)}: {'joined already' if joined else 'no keyframe names it'},"
                f" or the map's own; {names}"
            )
    transform = _transform(dx, dy, dyaw, may_stay=True)
    return build(commands.JoinFrames, stamp, frame=frame, into=into, transform=transform)


def by_alignment(
    current: MapToEdit,
    stamp: Stamp,
    run_id: str,
    target: str | None,
    span: Span,
    dx: float,
    dy: float,
    dyaw: float,
) -> commands.CorrectPoses | commands.JoinFrames:
    """The move of a run into the frame of the run ``target``, or of another log: where it brings a
    frame that is held apart to another one, of all that is in that frame. So too for a ``span`` of
    a run that is in a frame which the rest of it is not. Raises MisuseError for a run in several
    frames, and for one of the map's own that would be moved to one held apart."""
    if span != Span(None, None):
        of_run = [
            (span.has(each.keyframe_id), frame)
            for each, frame in _frames(current.reader, current.view)
            if each.run_id == run_id
        ]
        inside, rest = ({f for is_in, f in of_run if is_in is side} for side in (True, False))
        only = next(iter(inside)) if len(inside) == 1 else None
        if only is not None and rest == {None}:
            return join_frames(current, stamp, only, None, dx, dy, dyaw)
    there = frames_of_runs(current.reader, current.view)
    if target not in there or span != Span(None, None):
        return by_transform(current, stamp, run_id, span, dx, dy, dyaw)
    for run in (RunId(run_id), RunId(target)):
        if len(frames := there.get(run, set())) > 1:
            named = ", ".join(sorted(visible(each or "the map's own") for each in frames))
            raise MisuseError(
                f"{visible(run)} has keyframes in several frames, {named}: which is aligned cannot"
                f" be told; `{advised('edit', current.reader.path, 'join-frames', 'FRAME')}` joins"
                " one"
            )
    (one,), (into,) = there.get(RunId(run_id), {None}), there[RunId(target)]
    if one == into:
        return by_transform(current, stamp, run_id, span, dx, dy, dyaw)
    if one is None:
        raise MisuseError(
            f"{visible(run_id)} is in the map's own frame, {visible(target)} in"
            f" {visible(str(into))}, which is held apart: give them the other way round, --run"
            f" {visible(target)} --to {visible(run_id)}"
        )
    return join_frames(current, stamp, one, into, dx, dy, dyaw)


def _transform(
    dx: float, dy: float, dyaw: float, *, may_stay: bool = False
) -> commands.RigidTransform:
    for name, value, most in (
        ("--dx", dx, MAX_POSITION_M),
        ("--dy", dy, MAX_POSITION_M),
        ("--dyaw", dyaw, commands.MAX_YAW_RAD),
    ):
        if not math.isfinite(value) or abs(value) > most:
            raise MisuseError(f"{name} {value}: not between ±{most:,.0f}")
    if not (dx or dy or dyaw or may_stay):
        raise MisuseError("--dx, --dy and --dyaw are all 0: nothing would move")
    return commands.RigidTransform.of(dx, dy, dyaw)


def _keyframes(current: MapToEdit, run_id: str, span: Span) -> list[RunKeyframe]:
    if span.first is not None and span.last is not None and span.last < span.first:
        raise MisuseError(f"--from {span.first} is more than --to {span.last}; swap them")
    check_run_in_map(current, run_id)
    found = [
        RunKeyframe(k.keyframe_id, k.timestamp)
        for k in current.run(run_id)
        if span.has(k.keyframe_id)
    ]
    if not found:
        raise MisuseError(
            f"no keyframe of {run_id} between --from and --to; {keyframes_of(current, run_id)}"
        )
    return found


def _refuse_unknown(current: MapToEdit, run_id: str, trajectory: Trajectory, laid: Laid) -> None:
    first = min(laid.unknown, key=lambda pose: pose.line)
    count = len(laid.unknown)
    more = f" (and {count - 1:,} more such lines)" if count > 1 else ""
    raise MisuseError(
        f"{trajectory.name}, line {first.line}: {run_id} has no keyframe {first.key!r}{more}; "
        f"{keyframes_of(current, run_id)}; --ignore-missing takes the poses of the others"
    )


def _nothing_laid(trajectory: Trajectory, keyframes: list[RunKeyframe], slack_s: float) -> str:
    first, last = trajectory.poses[0].key, trajectory.poses[-1].key
    if trajectory.by == "keyframe":
        return f"{trajectory.name}: none of its keyframes, {first!r} to {last!r}, is in the run"
    stamps = [k.timestamp for k in keyframes]
    return (
        f"{trajectory.name}: its stamps, {first!r} to {last!r} s, are not those of the run's "
        f"keyframes, {min(stamps)!r} to {max(stamps)!r} s (--slack {slack_s:g} s); stamps must be "
        "of the robot's clock"
    )


def _note_left(
    note: Callable[[str], None], run_id: str, trajectory: Trajectory, laid: Laid, slack_s: float
) -> None:
    if trajectory.is_open:
        note(f"{trajectory.name}: its last line has no line end; if it was cut, so is a number")
    if laid.left:
        names = ", ".join(f"{run_id}:{k}" for k in laid.left[:_MOST_NAMED])
        count = len(laid.left)
        more = f" and {count - _MOST_NAMED:,} more" if count > _MOST_NAMED else ""
        why = (
            "not in the file"
            if trajectory.by == "keyframe"
            else f"more than --slack {slack_s:g} s outside its stamps"
        )
        note(f"{counted(count, 'keyframe')} left without correction, {why}: {names}{more}")
    if laid.widest_s > 0.0:
        note(f"poses interpolated over up to {laid.widest_s:.3g} s between two of the file")
    if laid.unknown:
        count = len(laid.unknown)
        note(f"{counted(count, 'pose')} not used: {run_id} has no such keyframe")
