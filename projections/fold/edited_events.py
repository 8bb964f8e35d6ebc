"""Events as the map has them, with keyframes and detections left out, poses corrected, classes
named and vectors added; and the map's embedding space, which decides which vectors are compared.

An event is corrected before it is folded, so the map is that of a log with the corrected events:
without forgotten keyframes, without dropped detections, with the corrected poses and the names of
classes written in. A
detection's position was computed from the recorded pose, so it moves and turns with that pose; in a
keyframe without a pose it is left out.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from eventsrc.base.text import command_line, visible
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import MAX_POSITION_M, Detection, DetId, Envelope, Offset, RunId

from .corrections import Corrections, logged_pose
from .exact import Units, cos_sin, unit_vectors
from .map_errors import ImpossibleCommand
from .pose_corrections import Pose, moved_by
from .settings import Settings
from .sights import small_angle


class EditedEvent(NamedTuple):
    """A corrected envelope; ``dropped`` are the det_ids it has lost."""

    accepted: Accepted
    units: Sequence[Units | None] | None
    dropped: tuple[DetId, ...]


class EventEdits:
    """The corrections of single events."""

    def __init__(self, corrections: Corrections) -> None:
        c = self._corrections = corrections
        changing = c.forgotten_runs, c.forgotten_ranges, c.dropped, c.poses, c.labels, c.frames
        self.any = any(map(bool, changing))
        """Whether any event can be changed."""
        self.expects = any(poses.are_many for poses in c.poses.values())
        """Whether `expect` saves time."""
        self._expected: dict[Offset, Pose | None] = {}

    def expect(self, coming: Iterable[tuple[Offset, Envelope]]) -> None:
        """Correct the poses of the envelopes that come next: many at once, which is quicker."""
        by_run: dict[RunId, list[tuple[Offset, Envelope]]] = {}
        for offset, envelope in coming:
            by_run.setdefault(envelope.run_id, []).append((offset, envelope))
        self._expected = {}
        for run_id, events in by_run.items():
            own = self._corrections.poses.get(run_id)
            if own is not None and own.are_many:
                poses = own.corrected_poses([(e.keyframe_id, logged_pose(e)) for _, e in events])
                offsets = (offset for offset, _ in events)
                self._expected.update(zip(offsets, poses, strict=True))

    def edited(
        self, offset: Offset, accepted: Accepted, units: Sequence[Units | None] | None
    ) -> EditedEvent | None:
        """The corrected event; None if it is left out. ``units`` runs parallel to the detections.

        Raises ImpossibleCommand for a pose that a correction moves out of the map.
        """
        corrections = self._corrections
        envelope, dropped = accepted.envelope, corrections.dropped
        if corrections.is_forgotten(envelope.run_id, envelope.keyframe_id):
            return None
        gone: tuple[DetId, ...] = ()
        if dropped and not dropped.isdisjoint(accepted.det_ids):
            gone = tuple(det_id for det_id in accepted.det_ids if det_id in dropped)
            kept = corrections.kept(accepted)
            units = None if units is None else [units[i] for i in kept]
            detections = tuple(envelope.detections[i] for i in kept)
            accepted = Accepted(
                replace(envelope, detections=detections),
                tuple(accepted.det_ids[i] for i in kept),
                tuple(accepted.vectors[i] for i in kept),
            )
        joins = corrections.frame_joins(envelope.frame)
        if envelope.run_id in corrections.poses or joins:
            expected = self._expected
            pose = expected[offset] if offset in expected else corrections.pose(envelope)
            for join in joins:
                pose = None if pose is None else moved_by(join.transform, pose)
            accepted = _with_pose(corrections, offset, accepted, pose)
        if joins:
            joined = replace(accepted.envelope, frame=joins[-1].into)
            accepted = Accepted(joined, accepted.det_ids, accepted.vectors)
        if corrections.labels:
            accepted = relabelled(accepted, corrections.labels)
        return EditedEvent(accepted, units, gone)


def relabelled(accepted: Accepted, labels: Mapping[str, str]) -> Accepted:
    """The envelope with the names of ``labels`` as the classes of its detections."""
    detections = accepted.envelope.detections
    if all(detection.class_name not in labels for detection in detections):
        return accepted
    named = (replace(d, class_name=labels.get(d.class_name, d.class_name)) for d in detections)
    envelope = replace(accepted.envelope, detections=tuple(named))
    return Accepted(envelope, accepted.det_ids, accepted.vectors)


def _with_pose(
    corrections: Corrections, offset: Offset, accepted: Accepted, pose: Pose | None
) -> Accepted:
    envelope = accepted.envelope
    if pose is None or pose == (envelope.map_x, envelope.map_y, envelope.map_yaw):
        return accepted
    x, y, yaw = pose
    if not is_in_bounds(pose):
        by = corrections.pose_command(envelope, is_in_bounds)
        command_id = visible(by.command.command_id)
        raise ImpossibleCommand(
            offset,
            f"{by.command.kind} {command_id} at offset {by.offset} moves keyframe "
            f"{envelope.keyframe_id} of run {envelope.run_id!r} to x={x!r}, y={y!r}, yaw={yaw!r}, "
            f"beyond ±{MAX_POSITION_M:,.0f} m; take it back: "
            f"{command_line('edit', 'LOG', 'undo', command_id, '--reason', 'WHY')}",
        )
    update: dict[str, Any] = {"map_x": x, "map_y": y, "map_yaw": yaw}
    if envelope.pose_covariance is not None:
        update["pose_covariance"] = _turned_covariance(envelope, yaw)
    if any(detection.position is not None for detection in envelope.detections):
        update["detections"] = _with_positions(envelope, pose)
    moved = replace(envelope, **update)
    return Accepted(moved, accepted.det_ids, accepted.vectors)


def _with_positions(envelope: Envelope, pose: tuple[float, float, float]) -> tuple[Detection, ...]:
    """The detections, with positions moved as the pose is."""
    old_x, old_y, old_yaw = envelope.map_x, envelope.map_y, envelope.map_yaw
    if old_x is None or old_y is None or old_yaw is None:
        return tuple(replace(d, position=None) for d in envelope.detections)
    x, y, yaw = pose
    cos, sin = cos_sin(small_angle(yaw) - small_angle(old_yaw))
    moved = []
    for detection in envelope.detections:
        if detection.position is not None:
            dx, dy = detection.position[0] - old_x, detection.position[1] - old_y
            position = x + (cos * dx - sin * dy), y + (sin * dx + cos * dy)
            detection = replace(detection, position=position)
        moved.append(detection)
    return tuple(moved)


def _turned_covariance(envelope: Envelope, yaw: float) -> tuple[float, ...] | None:
    """The covariance of the pose, turned as the pose is; None if there was no pose."""
    nine = envelope.pose_covariance
    if nine is None or envelope.map_yaw is None:
        return None
    cos, sin = cos_sin(small_angle(yaw) - small_angle(envelope.map_yaw))
    xx, xy, xw, _, yy, yw, _, _, ww = nine
    across = 2.0 * cos * sin * xy
    xx, yy = (
        max(cos * cos * xx - across + sin * sin * yy, 0.0),
        max(sin * sin * xx + across + cos * cos * yy, 0.0),
    )
    xy = cos * sin * (nine[0] - nine[4]) + (cos * cos - sin * sin) * xy
    xw, yw = cos * xw - sin * yw, sin * xw + cos * yw
    return xx, xy, xw, xy, yy, yw, xw, yw, ww


def is_in_bounds(pose: tuple[float, float, float]) -> bool:
    """Whether a pose is within the bounds of a map."""
    x, y, yaw = pose
    return abs(x) <= MAX_POSITION_M and abs(y) <= MAX_POSITION_M and math.isfinite(yaw)


class Space:
    """The map's embedding space, a model and a dimension; open until it is decided.

    Parts that the settings leave open are fixed by the first embedded detection that matches the
    settings. A vector of another space is *foreign*: it is counted, but neither fused nor searched.
    A detection that names no model is of the unnamed model, which is a model like any other.
    """

    def __init__(self, settings: Settings) -> None:
        self._wanted_model = settings.embedding_model
        self._wanted_dim = settings.embedding_dim
        self.is_decided = False
        self.model: str | None = None
        self.dim = 0

    def decide(self, model: str | None, dim: int) -> None:
        """Fix the space."""
        self.is_decided, self.model, self.dim = True, model, dim

    def has(self, model: str | None, dim: int) -> bool:
        """Whether vectors of this model and dimension are in the map; the first one fixes an open
        space."""
        if model == self.model and dim == self.dim:
            return True
        if not self.is_decided:
            if self._wanted_model not in (None, model) or self._wanted_dim not in (None, dim):
                return False
            self.decide(model, dim)
            return True
        return False


class Reembedded:
    """Vectors of one space by det_id, float32. The map is that of a log in which they were recorded
    with their detections; a detection that has a vector of the space keeps its own."""

    def __init__(self, space: str, vectors: dict[DetId, NDArray[np.float32]]) -> None:
        self.space = space
        self._vectors = vectors

    def __contains__(self, det_id: DetId) -> bool:
        return det_id in self._vectors

    def applied(
        self, accepted: Accepted, units: Sequence[Units | None]
    ) -> tuple[Accepted, Sequence[Units | None]]:
        """The envelope and its ``units``, with the vectors of this space added to its
        detections."""
        envelope, rows = accepted.envelope, self._vectors
        models = [detection.embedding_model for detection in envelope.detections]
        given = {
            i: rows[det_id]
            for i, (det_id, own) in enumerate(zip(accepted.det_ids, accepted.vectors, strict=True))
            if det_id in rows and (own is None or models[i] != self.space)
        }
        if not given:
            return accepted, units
        detections, vectors = list(envelope.detections), list(accepted.vectors)
        changed = list(units)
        for i, unit in zip(given, unit_vectors(list(given.values())), strict=True):
            detections[i] = replace(detections[i], embedding_model=self.space)
            vectors[i], changed[i] = given[i], unit
        edited = replace(envelope, detections=tuple(detections))
        return Accepted(edited, accepted.det_ids, tuple(vectors)), changed
