"""Corrections: the commands of a log compiled to one value that the fold obeys.

**The map at W is the fold of the events before W under the commands recorded before V**, V being W
unless asked otherwise. A command is retroactive: it changes how earlier events are folded, as if it
had always been known, but only from the offset where it was recorded.

1.  A command is in force unless a later one in force undoes it.
2.  ``join`` is transitive: of anchors joined in a chain all are one, and what is kept apart from
    one is kept apart from them all. A ``keep-apart`` or ``join`` that contradicts later ones does
    not count. So too for ``different-objects`` and ``same-object`` of det_ids.
3.  Pose corrections of a keyframe apply in the order of the commands; then its frame is joined to
    another, and that to a further one. A ``join-frames`` that would close a circle with later ones
    does not count.
4.  Of two names of one place or of one recorded label, of two ``use-settings``, and of two
    ``join-frames`` of one frame, the later one counts.

`Corrections` has a fingerprint, which with that of the settings is part of a map's identity.
"""

import hashlib
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Final, NamedTuple

import msgspec

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectPoses,
    NamePlace,
    Reembed,
    RigidTransform,
    UseSettings,
)
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import DetId, Envelope, KeyframeId, Offset, RunId

from .pair_groups import ApartPairs, without_contradictions
from .pose_corrections import Pose, PoseCorrection, PoseCorrections, moved_by
from .settings import Settings


class Keyframe(NamedTuple):
    """The identity of a keyframe in a log."""

    run_id: RunId
    keyframe_id: KeyframeId


class PlaceName(NamedTuple):
    """The place of ``anchor`` is called ``name``, by the command at ``offset``."""

    anchor: Keyframe
    name: str
    offset: Offset


class FrameJoin(NamedTuple):
    """Poses in ``frame`` are moved into ``into``, None for the map's own, as of ``offset``."""

    frame: str
    into: str | None
    transform: RigidTransform
    offset: Offset


class RecordedCommand(NamedTuple):
    """A command and the offset of its event."""

    offset: Offset
    command: Command


class Corrections(msgspec.Struct, frozen=True, eq=False, dict=True):
    """The compiled corrections of a fold; `compile_corrections` makes them. Pairs are in ascending
    order. ``settings`` are those of the log, None if it names none. ``in_force`` are the commands
    that were not undone or replaced, in the order of the log."""

    in_force: tuple[RecordedCommand, ...] = ()
    forgotten_runs: frozenset[RunId] = frozenset()
    forgotten_ranges: dict[RunId, tuple[tuple[KeyframeId, KeyframeId], ...]] = {}
    dropped: frozenset[DetId] = frozenset()
    poses: dict[RunId, PoseCorrections] = {}
    apart: ApartPairs[Keyframe] = ApartPairs()
    joined: tuple[tuple[Keyframe, Keyframe], ...] = ()
    different: ApartPairs[DetId] = ApartPairs()
    same: tuple[tuple[DetId, DetId], ...] = ()
    names: tuple[PlaceName, ...] = ()
    settings: Settings | None = None
    reembedded: tuple[Reembed, ...] = ()
    labels: dict[str, str] = {}
    """Names of classes by recorded label; below, joins of frames by the frame that is moved."""
    frames: dict[str, FrameJoin] = {}

    def fingerprint(self) -> str:
        """16 hex digits that are equal for equal corrections; empty if there are none that change
        the fold. The log's settings are not part of it: they have a fingerprint of their own. Nor
        are vectors, which only a map of their space has (`map_fingerprint`)."""
        return self._fingerprint

    @cached_property
    @gc_paused()
    def _fingerprint(self) -> str:
        rows = self._canonical()
        if not any(rows):
            return ""
        sha, before = hashlib.sha256(), b"["
        for row in rows:
            sha.update(before)
            for piece in _json_of(row):
                sha.update(piece)
            before = b","
        sha.update(b"]")
        return sha.hexdigest()[:16]

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
        return self._nameless if self.names else self

    @cached_property
    def _nameless(self) -> "Corrections":
        return msgspec.structs.replace(self, names=())

    def with_more_names(self, commands: Sequence[RecordedCommand]) -> "Corrections":
        """The corrections of later commands too, which must be ``name-place``, each with a
        command_id that no earlier command has."""
        names = [
            PlaceName(_keyframe(command.place), command.name, offset)
            for offset, command in commands
            if isinstance(command, NamePlace)
        ]
        return msgspec.structs.replace(
            self, in_force=(*self.in_force, *commands), names=(*self.names, *names)
        )

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
            and self.labels == other.labels
            and self.frames == other.frames
        )

    def is_forgotten(self, run_id: RunId, keyframe_id: KeyframeId) -> bool:
        """Whether a keyframe is left out of the fold."""
        if run_id in self.forgotten_runs:
            return True
        starts, ends = self._forgotten.get(run_id, ((), ()))
        at = bisect_right(starts, keyframe_id) - 1
        return at >= 0 and keyframe_id <= ends[at]

    @cached_property
    def _forgotten(self) -> dict[RunId, tuple[list[KeyframeId], list[KeyframeId]]]:
        """The first and the last keyframes of the forgotten ranges of each run, which are ascending
        and have no keyframe in common."""
        found = {}
        for run_id, ranges in self.forgotten_ranges.items():
            starts, ends = list[KeyframeId](), list[KeyframeId]()
            for first, last in sorted(ranges):
                if ends and first <= ends[-1]:
                    ends[-1] = max(last, ends[-1])
                else:
                    starts.append(first)
                    ends.append(last)
            found[run_id] = starts, ends
        return found

    def pose(self, envelope: Envelope) -> Pose | None:
        """The envelope's pose in its own frame, corrected as one of its run; None without one."""
        pose, own = logged_pose(envelope), self.poses.get(envelope.run_id)
        return pose if own is None else own.corrected(envelope.keyframe_id, pose)

    def frame_joins(self, frame: str | None) -> list[FrameJoin]:
        """The joins that move poses in a frame, in the order in which they do."""
        joins = list[FrameJoin]()
        while frame is not None and (join := self.frames.get(frame)) is not None:
            joins.append(join)
            frame = join.into
        return joins

    def pose_command(self, envelope: Envelope, is_good: Callable[[Pose], bool]) -> RecordedCommand:
        """The command that invalidates the envelope's pose: the last one that turns a good pose
        into one that is not. Raises ValueError if the corrected pose is good."""
        pose, good, found = logged_pose(envelope), True, None
        for recorded in self.in_force:
            command = recorded.command
            if isinstance(command, CorrectPoses) and command.run_id == envelope.run_id:
                pose = PoseCorrection.of(command).corrected(envelope.keyframe_id, pose)
                was_good, good = good, pose is None or is_good(pose)
                found = None if good else recorded if was_good else found
        by_offset = {recorded.offset: recorded for recorded in self.in_force}
        for join in self.frame_joins(envelope.frame):
            pose = None if pose is None else moved_by(join.transform, pose)
            was_good, good = good, pose is None or is_good(pose)
            found = None if good else by_offset[join.offset] if was_good else found
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
        rows: list[object] = [
            sorted(self.forgotten_runs),
            sorted(self.forgotten_ranges.items()),
            sorted(self.dropped),
            [(run, each.normal_order) for run, each in sorted(self.poses.items())],
            self.apart,
            sorted(self.joined),
            self.different,
            sorted(self.same),
            [(n.anchor, n.name) for n in self.names if newest[n.anchor] is n],
        ]
        renamed = sorted((label, name) for label, name in self.labels.items() if label != name)
        if renamed:  # a fingerprint without labels and frames is as it was before there were any
            rows.append(renamed)
        if self.frames:
            joins = [(f, j.into, *dict(j.transform).values()) for f, j in self.frames.items()]
            rows.append({"frames": sorted(joins)})
        return rows


NO_CORRECTIONS = Corrections()


EVIDENCE_VERSION: Final = 3
"""To be raised with every change of fusion by evidence, or of where its Objects are located, that
changes the map of some log: databases of such maps are then to be rebuilt."""


def map_fingerprint(settings: Settings, corrections: Corrections) -> str:
    """16 hex digits that are equal for maps of the same settings, corrections and rules."""
    vectors = (each.sha256 for each in corrections.reembedded_for(settings))
    rules = f"rules {EVIDENCE_VERSION} " if settings.fusion == "evidence" else ""
    own = rules + " ".join((corrections.fingerprint(), *vectors)).strip()
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
    for command_id, recorded in reversed(by_id.items()):
        if command_id in undone:
            continue
        if recorded.command.kind == "undo":
            undone.add(recorded.command.undone)
        else:
            kept.append(recorded)
    return kept[::-1]


@gc_paused()
def compile_corrections(commands: Iterable[RecordedCommand]) -> Corrections:
    """The corrections of a log's commands, given in the order of the log."""
    in_force = commands_in_force(commands)
    runs: set[RunId] = set()
    ranges: dict[RunId, list[tuple[KeyframeId, KeyframeId]]] = {}
    dropped: set[DetId] = set()
    poses: dict[RunId, list[PoseCorrection]] = {}
    places: list[tuple[tuple[Keyframe, ...], bool]] = []
    objects: list[tuple[tuple[DetId, ...], bool]] = []
    names: list[PlaceName] = []
    document: Mapping[str, object] | None = None
    reembedded: list[Reembed] = []
    labels: dict[str, str] = {}
    frames: dict[str, FrameJoin] = {}
    for offset, command in in_force:
        match command.kind:  # the classes of pydantic are slow to match
            case "name-place":
                names.append(PlaceName(_keyframe(command.place), command.name, offset))
            case "keep-apart" | "undo-merge":
                places.append((_keyframes(command.places), False))
            case "join" if len(joined_places := _keyframes(command.places)) > 1:
                places.append((joined_places, True))
            case "same-object" | "different-objects":
                first, second = sorted(command.det_ids)
                objects.append(((first, second), command.kind == "same-object"))
            case "drop-object" | "drop-detection":
                dropped.update(command.det_ids)
            case "forget-run":
                runs.add(command.run_id)
            case "forget-keyframes":
                ranges.setdefault(command.run_id, []).append((command.first, command.last))
            case "correct-poses":
                poses.setdefault(command.run_id, []).append(PoseCorrection.of(command))
            case "relabel":
                labels.update(command.labels)
            case "use-settings":
                document = command.settings
            case "reembed":
                reembedded.append(command)
            case "join-frames":
                frames.pop(command.frame, None)  # so that it is the last
                one, into, by = command.frame, command.into, command.transform
                frames[one] = FrameJoin(one, into, by, offset)
            case "join" | "undo":
                pass
    joined, apart = without_contradictions(places)
    same, different = without_contradictions(objects)
    return Corrections(
        in_force=tuple(in_force),
        forgotten_runs=frozenset(runs),
        forgotten_ranges={run: tuple(sorted(set(rs))) for run, rs in ranges.items()},
        dropped=frozenset(dropped),
        poses={run: PoseCorrections(each) for run, each in poses.items()},
        apart=apart,
        joined=tuple(joined),
        different=different,
        same=tuple(same),
        names=tuple(names),
        settings=None if document is None else Settings.from_document(document),
        reembedded=tuple(reembedded),
        labels=labels,
        frames=_without_circles(frames),
    )


def _without_circles(frames: dict[str, FrameJoin]) -> dict[str, FrameJoin]:
    kept: dict[str, FrameJoin] = {}
    for frame, join in reversed(frames.items()):
        into = join.into
        while into in kept:
            into = kept[into].into
        if into != frame:
            kept[frame] = join
    return kept


def _json_of(row: object) -> Iterator[bytes]:
    """The JSON of a row, in pieces. Pairs that are apart are written as a list of them, of which
    one thing's are made at a time: there may be millions."""
    if not isinstance(row, ApartPairs):
        yield msgspec.json.encode(row)
        return
    written = [msgspec.json.encode(thing) for thing in row.things]
    before = b"["
    for number, greater in row.greater():
        start = b"[" + written[number] + b","
        pairs = (b"]," + start).join([written[other] for other in greater])
        yield before + start + pairs + b"]"
        before = b","
    yield b"]" if row else b"[]"


def check_settings(command: Command) -> None:
    """Raises SettingsError if a ``use-settings`` has settings that no fold could have.

    Checked before a command is recorded: in the log it would stop every fold.
    """
    if isinstance(command, UseSettings):
        Settings.from_document(command.settings)


def _keyframe(anchor: Anchor) -> Keyframe:
    return Keyframe(anchor.run_id, anchor.keyframe_id)


def logged_pose(envelope: Envelope) -> Pose | None:
    """The envelope's pose as it was recorded, metres and radians; None if it has none."""
    x, y, yaw = envelope.map_x, envelope.map_y, envelope.map_yaw
    return None if x is None or y is None or yaw is None else (x, y, yaw)


def _keyframes(anchors: tuple[Anchor, ...]) -> tuple[Keyframe, ...]:
    """The different keyframes among anchors, ascending."""
    return tuple(sorted({_keyframe(anchor) for anchor in anchors}))
