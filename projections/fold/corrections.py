"""Corrections: the commands of a log compiled to one value that the fold obeys.

**The map at W is the fold of the events before W under the commands recorded before V**, V being W
unless asked otherwise. A command is retroactive: it changes how earlier events are folded, as if it
had always been known, but only from the offset where it was recorded.

1.  A command is in force unless a later one in force undoes it.
2.  ``join`` is transitive: of anchors joined in a chain all are one, and what is kept apart from
    one is kept apart from them all. A ``keep-apart`` or ``join`` that contradicts later ones does
    not count. So too for ``different-objects`` and ``same-object`` of det_ids.
3.  Pose corrections of a keyframe apply in the order of the commands.
4.  Of two names of one place, and of two ``use-settings``, the later one counts.

`Corrections` has a fingerprint, which with that of the settings is part of a map's identity.
"""

import hashlib
import heapq
import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeAlias

import msgspec

from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    DropObject,
    ForgetKeyframes,
    ForgetRun,
    Join,
    KeepApart,
    NamePlace,
    Reembed,
    RigidTransform,
    SameObject,
    Undo,
    UndoMerge,
    UseSettings,
)
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import DetId, Envelope, KeyframeId, Offset, RunId

from .pair_groups import without_contradictions
from .settings import Settings

Pose: TypeAlias = tuple[float, float, float]
"""Metres, metres, radians."""


class Keyframe(NamedTuple):
    """The identity of a keyframe in a log."""

    run_id: RunId
    keyframe_id: KeyframeId


class PlaceName(NamedTuple):
    """The place of ``anchor`` is called ``name``, by the command at ``offset``."""

    anchor: Keyframe
    name: str
    offset: Offset


class RecordedCommand(NamedTuple):
    """A command and the offset of its event."""

    offset: Offset
    command: Command


class PoseCorrection(NamedTuple):
    """One command's correction of a run's poses: ``poses`` by keyframe, or ``transform`` of the
    keyframes from ``first`` to ``last``, None for no bound."""

    poses: dict[KeyframeId, Pose]
    transform: RigidTransform | None
    first: KeyframeId | None
    last: KeyframeId | None

    def corrected(self, keyframe_id: KeyframeId, pose: Pose | None) -> Pose | None:
        """A keyframe's pose after this; a transform gives none to one that has none."""
        return self.poses.get(keyframe_id) if pose is None else self.apply(keyframe_id, pose)

    def apply(self, keyframe_id: KeyframeId, pose: Pose) -> Pose:
        """A keyframe's corrected pose: metres, metres, radians."""
        if self.transform is None:
            return self.poses.get(keyframe_id, pose)
        if self.first is not None and keyframe_id < self.first:
            return pose
        if self.last is not None and keyframe_id > self.last:
            return pose
        t, (x, y, yaw) = self.transform, pose
        return (t.cos * x - t.sin * y + t.dx, t.sin * x + t.cos * y + t.dy, yaw + t.dyaw)


class Corrections(msgspec.Struct, frozen=True, eq=False):
    """The compiled corrections of a fold; `compile_corrections` makes them. Pairs are in ascending
    order.

    ``settings`` are those of the log, None if it names none. ``in_force`` are the commands that
    were not undone or replaced, in the order of the log.
    """

    in_force: tuple[RecordedCommand, ...] = ()
    forgotten_runs: frozenset[RunId] = frozenset()
    forgotten_ranges: dict[RunId, tuple[tuple[KeyframeId, KeyframeId], ...]] = {}
    dropped: frozenset[DetId] = frozenset()
    poses: dict[RunId, tuple[PoseCorrection, ...]] = {}
    apart: tuple[tuple[Keyframe, Keyframe], ...] = ()
    joined: tuple[tuple[Keyframe, Keyframe], ...] = ()
    different: tuple[tuple[DetId, DetId], ...] = ()
    same: tuple[tuple[DetId, DetId], ...] = ()
    names: tuple[PlaceName, ...] = ()
    settings: Settings | None = None
    reembedded: tuple[Reembed, ...] = ()

    def fingerprint(self) -> str:
        """16 hex digits that are equal for equal corrections; empty if there are none that change
        the fold. The log's settings are not part of it: they have a fingerprint of their own. Nor
        are vectors, which only a map of their space has (`map_fingerprint`)."""
        rows = self._canonical()
        if not any(rows):
            return ""
        return hashlib.sha256(msgspec.json.encode(rows)).hexdigest()[:16]

    def reembedded_for(self, settings: Settings) -> tuple[Reembed, ...]:
        """The commands whose vectors a map of these settings has. It must name its space: the first
        vectors of a log decide it otherwise, and no command changes what came first."""
        return tuple(
            each
            for each in self.reembedded
            if each.space == settings.embedding_model and settings.embedding_dim in (None, each.dim)
        )

    def without_names(self) -> "Corrections":
        """These corrections without names of places, which change nothing else."""
        return msgspec.structs.replace(self, names=())

    def differs_in_names_only(self, other: "Corrections") -> bool:
        """Whether the two fold a log to the same map but for names of places."""
        return self is other or (
            self.forgotten_runs == other.forgotten_runs
            and self.forgotten_ranges == other.forgotten_ranges
            and self.dropped == other.dropped
            and self.poses == other.poses
            and self.apart == other.apart
            and self.joined == other.joined
            and self.different == other.different
            and self.same == other.same
        )

    def is_forgotten(self, run_id: RunId, keyframe_id: KeyframeId) -> bool:
        """Whether a keyframe is left out of the fold."""
        ranges = self.forgotten_ranges.get(run_id, ())
        return run_id in self.forgotten_runs or any(a <= keyframe_id <= b for a, b in ranges)

    def pose(self, envelope: Envelope) -> Pose | None:
        """The envelope's corrected pose, metres and radians; None if it has none."""
        pose = _logged_pose(envelope)
        for correction in self.poses.get(envelope.run_id, ()):
            pose = correction.corrected(envelope.keyframe_id, pose)
        return pose

    def pose_command(self, envelope: Envelope, is_good: Callable[[Pose], bool]) -> RecordedCommand:
        """The command that invalidates the envelope's pose: the last one that turns a good pose
        into one that is not. Raises ValueError if the corrected pose is good."""
        pose, good, found = _logged_pose(envelope), True, None
        for recorded in self.in_force:
            command = recorded.command
            if isinstance(command, CorrectPoses) and command.run_id == envelope.run_id:
                pose = _pose_correction(command).corrected(envelope.keyframe_id, pose)
                was_good, good = good, pose is None or is_good(pose)
                found = None if good else recorded if was_good else found
        if found is None:
            raise ValueError("the corrected pose is good")
        return found

    def kept(self, accepted: Accepted) -> list[int]:
        """Indices of an envelope's detections that are in the map."""
        dropped = self.dropped
        return [i for i, det_id in enumerate(accepted.det_ids) if det_id not in dropped]

    def _canonical(self) -> list[object]:
        # In the order of the commands, for two anchors may come to be in one place.
        newest = {name.anchor: name for name in self.names}
        return [
            sorted(self.forgotten_runs),
            sorted(self.forgotten_ranges.items()),
            sorted(self.dropped),
            [(run, _normal_order(cs)) for run, cs in sorted(self.poses.items())],
            sorted(self.apart),
            sorted(self.joined),
            sorted(self.different),
            sorted(self.same),
            [(n.anchor, n.name) for n in self.names if newest[n.anchor] is n],
        ]


NO_CORRECTIONS = Corrections()


def map_fingerprint(settings: Settings, corrections: Corrections) -> str:
    """16 hex digits that are equal for maps of the same settings and corrections."""
    vectors = (each.sha256 for each in corrections.reembedded_for(settings))
    own = " ".join((corrections.fingerprint(), *vectors)).strip()
    if not own:
        return settings.fingerprint()
    return hashlib.sha256(f"{settings.fingerprint()} {own}".encode()).hexdigest()[:16]


def commands_in_force(commands: Iterable[RecordedCommand]) -> list[RecordedCommand]:
    """The commands that no later command in force undoes (rule 1), in order; undos are left out.

    Of commands with one command_id the first counts: the others are the same one, sent again.
    """
    undone: set[str] = set()
    kept: list[RecordedCommand] = []
    by_id: dict[str, RecordedCommand] = {}
    for recorded in commands:
        by_id.setdefault(recorded.command.command_id, recorded)
    for recorded in reversed(by_id.values()):
        command = recorded.command
        if command.command_id in undone:
            continue
        if isinstance(command, Undo):
            undone.add(command.undone)
        else:
            kept.append(recorded)
    return kept[::-1]


def compile_corrections(commands: Iterable[RecordedCommand]) -> Corrections:
    """The corrections of a log's commands, given in the order of the log."""
    in_force = commands_in_force(commands)
    runs: set[RunId] = set()
    ranges: dict[RunId, list[tuple[KeyframeId, KeyframeId]]] = {}
    dropped: set[DetId] = set()
    poses: dict[RunId, list[PoseCorrection]] = {}
    places: list[tuple[tuple[Keyframe, Keyframe], bool]] = []
    objects: list[tuple[tuple[DetId, DetId], bool]] = []
    names: list[PlaceName] = []
    settings: Settings | None = None
    reembedded: list[Reembed] = []
    for offset, command in in_force:
        match command:
            case NamePlace():
                names.append(PlaceName(_keyframe(command.place), command.name, offset))
            case KeepApart() | UndoMerge():
                places += [(pair, False) for pair in _pairs(command.places)]
            case Join():
                places += [(pair, True) for pair in _pairs(command.places)]
            case SameObject() | DifferentObjects():
                first, second = sorted(command.det_ids)
                objects.append(((first, second), isinstance(command, SameObject)))
            case DropObject() | DropDetection():
                dropped.update(command.det_ids)
            case ForgetRun():
                runs.add(command.run_id)
            case ForgetKeyframes():
                ranges.setdefault(command.run_id, []).append((command.first, command.last))
            case CorrectPoses():
                poses.setdefault(command.run_id, []).append(_pose_correction(command))
            case UseSettings():
                settings = Settings.from_document(command.settings)
            case Reembed():
                reembedded.append(command)
            case Undo():
                pass
    joined, apart = without_contradictions(places)
    same, different = without_contradictions(objects)
    return Corrections(
        in_force=tuple(in_force),
        forgotten_runs=frozenset(runs),
        forgotten_ranges={run: tuple(sorted(set(rs))) for run, rs in ranges.items()},
        dropped=frozenset(dropped),
        poses={run: tuple(cs) for run, cs in poses.items()},
        apart=tuple(apart),
        joined=tuple(joined),
        different=tuple(different),
        same=tuple(same),
        names=tuple(names),
        settings=settings,
        reembedded=tuple(reembedded),
    )


def check_settings(command: Command) -> None:
    """Raises SettingsError if a ``use-settings`` has settings that no fold could have.

    Checked before a command is recorded: in the log it would stop every fold.
    """
    if isinstance(command, UseSettings):
        Settings.from_document(command.settings)


def _keyframe(anchor: Anchor) -> Keyframe:
    return Keyframe(anchor.run_id, anchor.keyframe_id)


def _logged_pose(envelope: Envelope) -> Pose | None:
    x, y, yaw = envelope.map_x, envelope.map_y, envelope.map_yaw
    return None if x is None or y is None or yaw is None else (x, y, yaw)


def _pose_correction(command: CorrectPoses) -> PoseCorrection:
    poses = {p.keyframe_id: (p.x, p.y, p.yaw) for p in command.poses}
    return PoseCorrection(poses, command.transform, command.first, command.last)


def _normal_order(corrections: Sequence[PoseCorrection]) -> list[object]:
    """One run's corrections, in an order that is the same for all orders with equal results.

    Two that have no keyframe in common can change places. So of those that need not come after one
    that is left, the one with the smallest row is next.
    """
    reaches = [_reach(correction) for correction in corrections]
    heads = {n: (_row(correction), n) for n, correction in enumerate(corrections)}
    after: dict[int, list[int]] = {n: [] for n in heads}
    waits = dict.fromkeys(heads, 0)
    for n, (low, high) in enumerate(reaches):
        for earlier, (first, last) in enumerate(reaches[:n]):
            if first <= high and low <= last:
                bounds = max(low, first), min(high, last)
                if _overlap(corrections[earlier], corrections[n], *bounds):
                    after[earlier].append(n)
                    waits[n] += 1
    ready = [heads[n] for n in heads if not waits[n]]
    heapq.heapify(ready)
    ordered = list[object]()
    while ready:
        row, n = heapq.heappop(ready)
        ordered.append(row)
        for later in after[n]:
            waits[later] -= 1
            if not waits[later]:
                heapq.heappush(ready, heads[later])
    return ordered


def _row(correction: PoseCorrection) -> tuple[object, ...]:
    """All of a correction, in values that have an order. An empty tuple stands for none."""
    bounds = [() if bound is None else (bound,) for bound in (correction.first, correction.last)]
    return sorted(correction.poses.items()), _numbers(correction.transform), *bounds


def _reach(correction: PoseCorrection) -> tuple[float, float]:
    """The smallest and the greatest keyframe that a correction can change."""
    if correction.transform is None:
        return min(correction.poses), max(correction.poses)
    first, last = correction.first, correction.last
    return -math.inf if first is None else first, math.inf if last is None else last


def _overlap(one: PoseCorrection, other: PoseCorrection, low: float, high: float) -> bool:
    """Whether two corrections have a keyframe in common, of those from ``low`` to ``high``, which
    both reach."""
    if low > high:
        return False
    sets = sorted((c.poses for c in (one, other) if c.transform is None), key=len)
    if len(sets) == 2:
        return not sets[0].keys().isdisjoint(sets[1])
    return not sets or any(low <= keyframe <= high for keyframe in sets[0])


def _pairs(anchors: tuple[Anchor, ...]) -> list[tuple[Keyframe, Keyframe]]:
    """Every two different anchors, the smaller one first."""
    keyframes = sorted({_keyframe(anchor) for anchor in anchors})
    return [(a, b) for i, a in enumerate(keyframes) for b in keyframes[i + 1 :]]


def _numbers(transform: RigidTransform | None) -> tuple[float, ...]:
    return () if transform is None else tuple(transform.model_dump().values())
