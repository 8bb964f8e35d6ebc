"""Fusion by evidence: runs the reducers of Objects and of presence, and finds relocations: new
Objects that are older ones moved since an earlier run.

A *newcomer* is an Object with `_LEAST_NEW` observations or more. Any Object of the same class that
another run found before, at least a metre away, may be the same thing, unless the newcomer's run
surely saw it at its old position: its odds to be still there (`presence`) are above `_STILL`. The
evidence is

    the log-likelihood ratio of their looks, whatever their headings (`turned_looks`), at least
    `_LEAST_LOOK`;
    less the largest such ratio, if above 0, of one of them and a third Object: of the newcomer and
    another older one, or of the older one and another that was seen since the newcomer's run began.
    Where things look alike a look is little evidence;
    less the logarithm of the older one's odds, or `_GONE` of it where they are below 1.

The older Object with the largest ratio of looks less the part of its odds is the newcomer, if the
evidence is `_ENOUGH`; of equal ones the latest.

A newcomer is compared when its observations have doubled, and an Object whose misses have doubled
with the newcomer that looks most like it. Of a class the latest `_MOST` Objects are kept, and of
newcomers, so the cost of a keyframe is bounded.
"""

from collections.abc import Container, Iterable, Sequence
from typing import NamedTuple, TypeAlias

from eventsrc.envelope.model import DetId, Offset

from . import State, part, prefixed
from . import deltas as d
from .evidence import EvidenceConstants
from .evidence_objects import EvidenceObjects, MovedObject, ObjectDelta
from .exact import log
from .objects import ConstrainedObjects, Objects
from .pair_groups import PairGroups
from .presence import Presence
from .settings import CameraConstants, Settings
from .sights import PoseError, Sighting

_LEAST_NEW, _LEAST_RIVAL = 3, 2
"""Fewest observations of a newcomer, and of a third Object."""
_APART_M2, _APART_CHI2 = 1.0, 16.0
_ONE_FLOOR_M2 = 5e7 * 5e7
"""Objects farther apart are on two floors, which are laid out beside each other."""
_LEAST_LOOK, _ENOUGH, _GONE = 2.0, 2.0, 0.5
_STILL = 8.0
_MOST = 128


class _Candidate(NamedTuple):
    value: float
    old: d.ObjectOrdinal
    look: float


class _Newcomer(NamedTuple):
    founded_by: d.ObservationOrdinal
    due_at: int  # observations at the next comparison


class Relocations:
    """The reducer."""

    def __init__(self, presence: Presence, objects: EvidenceObjects) -> None:
        self._presence = presence
        self._objects = objects
        self._newcomers: dict[d.ObjectOrdinal, _Newcomer] = {}
        self._class_of: dict[d.ObjectOrdinal, str] = {}
        self._by_class: dict[str, dict[d.ObjectOrdinal, None]] = {}

    def fold(self, fused: Iterable[d.Delta]) -> list[MovedObject]:
        """The Objects found to be relocated; the caller merges the two of each.

        ``fused`` are the deltas of fusion; `Presence` must have applied them.
        """
        pairs: list[MovedObject] = []
        due = self._apply(fused)
        for ordinal in self._presence.missed:
            misses = self._presence.attendance[ordinal].run_misses
            if misses & (misses - 1) == 0:
                due += self._newcomer_like(ordinal)
        for newcomer in dict.fromkeys(due):
            best = self._best(newcomer)
            if best is not None:
                first = self._newcomers[newcomer].founded_by
                pairs.append(MovedObject(best.old, newcomer, first, best.look))
                self._forget(newcomer)
                self._newcomers.pop(best.old, None)
        return pairs

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {
            "newcomers": [[ordinal, *newcomer] for ordinal, newcomer in self._newcomers.items()],
            "classes": [[name, list(own)] for name, own in sorted(self._by_class.items())],
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        for ordinal, first, due_at in state["newcomers"]:
            self._newcomers[ordinal] = _Newcomer(first, due_at)
        for name, ordinals in state["classes"]:
            for ordinal in ordinals:
                self._classify(ordinal, name)

    def _apply(self, fused: Iterable[d.Delta]) -> list[d.ObjectOrdinal]:
        """Apply the deltas; the newcomers whose comparison is due."""
        due: list[d.ObjectOrdinal] = []
        for delta in fused:
            if type(delta) is d.ObjectFound:
                self._classify(delta.object, delta.class_name)
                self._newcomers[delta.object] = _Newcomer(delta.observation, _LEAST_NEW)
                if len(self._newcomers) > _MOST:
                    del self._newcomers[next(iter(self._newcomers))]
            elif type(delta) is d.ObjectClassified:
                self._classify(delta.object, delta.class_name)
            elif type(delta) is d.ObjectSeen:
                newcomer = self._newcomers.get(delta.object)
                if newcomer is not None and delta.obs_count >= newcomer.due_at:
                    due_at = 2 * delta.obs_count
                    self._newcomers[delta.object] = newcomer._replace(due_at=due_at)
                    due.append(delta.object)
            elif type(delta) is d.ObjectsMerged:
                self._forget(delta.absorbed)
        return [ordinal for ordinal in due if ordinal in self._newcomers]

    def _newcomer_like(self, old: d.ObjectOrdinal) -> list[d.ObjectOrdinal]:
        """The newcomer that looks most like an Object, of equal ones the latest; none if its ratio
        is too low."""
        own = self._by_class.get(self._objects.class_of(old), {})
        newcomers = [
            ordinal
            for ordinal in own
            if ordinal in self._newcomers
            and self._objects.observations_of(ordinal) >= _LEAST_NEW
            and self._could_be(old, ordinal)
        ]
        looks = zip(self._objects.compare(old, newcomers), newcomers, strict=True)
        alike = [(look, new) for look, new in looks if look is not None and look >= _LEAST_LOOK]
        return [max(alike)[1]] if alike else []

    def _best(self, newcomer: d.ObjectOrdinal) -> _Candidate | None:
        """The older Object that the newcomer is; None if it is none."""
        own = self._by_class.get(self._objects.class_of(newcomer), {})
        observations_of = self._objects.observations_of
        mates = [o for o in own if o != newcomer]
        if not any(self._could_be(old, newcomer) for old in mates):
            return None
        attendance = self._presence.attendance
        home = attendance[newcomer].home
        looks = dict(zip(mates, self._objects.compare(newcomer, mates), strict=True))
        best: _Candidate | None = None
        for old, look in looks.items():
            if look is not None and look >= _LEAST_LOOK and self._could_be(old, newcomer):
                odds = log(attendance[old].odds)
                candidate = _Candidate(look - (_GONE * odds if odds < 0.0 else odds), old, look)
                best = candidate if best is None else max(best, candidate)
        if best is None or best.value < _ENOUGH:
            return None
        others = [o for o in mates if o != best.old and observations_of(o) >= _LEAST_RIVAL]
        older = [looks[other] for other in others if attendance[other].home < home]
        later = [other for other in others if attendance[other].seen >= home]
        later_looks = self._objects.compare(best.old, later)
        rival = max([look for look in (*older, *later_looks) if look is not None], default=0.0)
        return best if best.value - max(rival, 0.0) >= _ENOUGH else None

    def _could_be(self, old: d.ObjectOrdinal, newcomer: d.ObjectOrdinal) -> bool:
        """Whether the two can be one thing, apart from their looks."""
        before, now = self._presence.attendance[old], self._presence.attendance[newcomer]
        pairs = zip(now.estimate, before.estimate, strict=True)
        (x, before_x), (y, before_y), *variances = pairs
        dx, dy = x - before_x, y - before_y
        xx, xy, yy = (one + other for one, other in variances)
        apart = yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy
        return (
            old < newcomer
            and now.home not in (before.home, before.confirmed)
            and before.odds <= _STILL
            and _APART_M2 <= dx * dx + dy * dy <= _ONE_FLOOR_M2
            and apart >= _APART_CHI2 * (xx * yy - xy * xy)
        )

    def _classify(self, ordinal: d.ObjectOrdinal, class_name: str) -> None:
        """Enter an Object as the latest of its class."""
        self._drop_class(ordinal)
        self._class_of[ordinal] = class_name
        own = self._by_class.setdefault(class_name, {})
        own[ordinal] = None
        if len(own) > _MOST:
            self._drop_class(next(iter(own)))

    def _drop_class(self, ordinal: d.ObjectOrdinal) -> None:
        class_name = self._class_of.pop(ordinal, None)
        if class_name is not None:
            own = self._by_class[class_name]
            del own[ordinal]
            if not own:
                del self._by_class[class_name]

    def _forget(self, ordinal: d.ObjectOrdinal) -> None:
        self._drop_class(ordinal)
        self._newcomers.pop(ordinal, None)


FusionDelta: TypeAlias = ObjectDelta | d.ObjectMissing


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
        run: d.RunOrdinal,
        timestamp: float,
        pose: d.Pose,
        camera: CameraConstants,
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
        """The whole state, to be kept."""
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
    fused: Sequence[ObjectDelta], absorbed: Container[d.ObjectOrdinal]
) -> list[ObjectDelta]:
    """Classes and estimates last, ascending, the latest of each Object that is left."""
    others: list[ObjectDelta] = []
    classes: dict[d.ObjectOrdinal, ObjectDelta] = {}
    estimates: dict[d.ObjectOrdinal, ObjectDelta] = {}
    for delta in fused:
        if type(delta) is d.ObjectClassified:
            classes[delta.object] = delta
        elif type(delta) is d.ObjectEstimated:
            estimates[delta.object] = delta
        else:
            others.append(delta)
    for latest in (classes, estimates):
        others += [latest[ordinal] for ordinal in sorted(latest) if ordinal not in absorbed]
    return others


def objects_by(settings: Settings, named: PairGroups[DetId]) -> Objects | EvidenceFusion:
    """The reducer of Objects; ``named`` are the detections that commands name."""
    groups = named if named.group_of else None
    if settings.fusion == "evidence":
        return EvidenceFusion(settings.evidence, groups)
    limits = settings.fusion_radius_m, settings.fusion_similarity
    return Objects(*limits) if groups is None else ConstrainedObjects(*limits, groups)
