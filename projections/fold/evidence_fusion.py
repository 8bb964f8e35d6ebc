"""Fusion by evidence: runs the reducers of Objects, of presence and of relocations."""

from collections.abc import Container, Sequence
from typing import TypeAlias

from eventsrc.envelope.model import DetId, Offset

from . import State, part, prefixed
from .deltas import (
    ObjectClassified,
    ObjectEstimated,
    ObjectMissing,
    ObjectOrdinal,
    Pose,
    RunOrdinal,
)
from .evidence import EvidenceConstants
from .evidence_objects import EvidenceObjects, ObjectDelta
from .pair_groups import PairGroups
from .presence import Presence
from .relocations import Relocations
from .settings import Camera
from .sights import PoseError, Sighting

FusionDelta: TypeAlias = ObjectDelta | ObjectMissing


class EvidenceFusion:
    """The reducer."""

    def __init__(
        self, constants: EvidenceConstants, groups: PairGroups[DetId] | None = None
    ) -> None:
        self._objects = EvidenceObjects(constants, groups)
        self._presence = Presence()
        self._relocations = Relocations(self._presence, self._objects)

    def fold(
        self,
        offset: Offset,
        run: RunOrdinal,
        timestamp: float,
        pose: Pose,
        camera: Camera,
        sightings: Sequence[Sighting],
        error: PoseError | None = None,
    ) -> list[FusionDelta]:
        """Fuse the observations of one picture, then count Objects that it should show and does
        not."""
        fused = self._objects.fold(offset, run, timestamp, pose, camera, sightings, error)
        missing = self._presence.fold(offset, run, pose, camera, fused)
        moved = self._relocations.fold(fused)
        if not moved:
            return [*fused, *missing]
        for pair in moved:
            fused += self._objects.relocate(offset, pair)
            self._presence.relocate(pair.old, pair.new)
        elsewhere = {ordinal for pair in moved for ordinal in (pair.old, pair.new)}
        left = [delta for delta in missing if delta.object not in elsewhere]
        return [*_in_order(fused, {pair.new for pair in moved}), *left]

    def dump(self) -> State:
        """The whole state, for a snapshot."""
        return (
            prefixed("landmarks", self._objects.dump())
            | prefixed("presence", self._presence.dump())
            | prefixed("relocations", self._relocations.dump())
        )

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._objects.load(part("landmarks", state))
        self._presence.load(part("presence", state))
        self._relocations.load(part("relocations", state))


def _in_order(
    fused: Sequence[ObjectDelta], absorbed: Container[ObjectOrdinal]
) -> list[ObjectDelta]:
    """Classes and estimates last, ascending, the latest of each Object that is left."""
    others: list[ObjectDelta] = []
    classes: dict[ObjectOrdinal, ObjectDelta] = {}
    estimates: dict[ObjectOrdinal, ObjectDelta] = {}
    for delta in fused:
        if type(delta) is ObjectClassified:
            classes[delta.object] = delta
        elif type(delta) is ObjectEstimated:
            estimates[delta.object] = delta
        else:
            others.append(delta)
    for latest in (classes, estimates):
        others += [latest[ordinal] for ordinal in sorted(latest) if ordinal not in absorbed]
    return others
