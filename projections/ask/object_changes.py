"""What became of the Objects of one map in a later one: moved, missing, joined, or seen again.

The fold decides: what has moved has a relocation (`fold.evidence_fusion`) and stands elsewhere by
more than both errors; what is not where it should be is missing (`fold.presence`). An estimate that
shifts without a relocation is better known, not moved; it is only counted. With fusion=page there
is no estimate, only the mean position of the robot, which says nothing about moves: of those that
shift by more than the spread of the positions 3 % were moved, so none is called so.

A change is *sure* when

* the Object's estimate before, and after a move the new one, has a standard error of at most
  `KNOWN_M`; and
* no other Object of its class stands, in the later map, where it stood: all are farther from there
  than both errors explain (`_BEYOND`). Otherwise it may have been exchanged for one that looks the
  same: where an alike one is at the old place, the one that is elsewhere is another; and
* of a moved Object, a later run looked at where it stood: else it may stand there still, and what
  was found elsewhere only looks like it; and
* of a missing Object, the run that misses it never saw it, and of the keyframes before that looked
  at where it stands `_SHARE` saw it, for what is often hidden or overlooked is missed easily; and
  keyframes since looked there along lines of sight `_TURN` apart or more, for what stands before it
  now hides it on one of them, not on both.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from projections.fold.exact import UM_PER_M
from projections.fold.presence import similar_sights, would_see
from projections.fold.sights import camera_of
from projections.map.phrases import seen_times
from projections.map.records import EstimatedPosition, KeyframeRecord, ObjectRecord, Relocation
from projections.map.view import MapView

KNOWN_M: Final = 0.5
_BEYOND: Final = 9.21
"""99 % of the squared normalised distances of two estimates of one position."""
_SHARE: Final = 0.4
"""On the developing half of generated buildings, three seeds, 50 of 56 absences are true without
this and `_TURN`, 43 of 46 where the run never saw it, 41 of 42 with the share too."""
_TURN: Final = math.radians(30.0)
"""Lines of sight closer than this are similar, as for `fold.presence`. With eight more robots, two
seeds, 51 of 54 absences are true without it, 42 of 42 with it."""
Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class ObjectRow:
    """An object: its mean position in metres, its detections in order; under fusion by evidence
    where it stands, and whether it is missing."""

    object_id: str
    class_name: str
    mean_x: float
    mean_y: float
    place_id: str | None
    first_seen: float
    last_seen: float
    det_ids: tuple[str, ...]
    estimate: EstimatedPosition | None = None
    missing: bool = False
    relocations: tuple[Relocation, ...] = ()
    confirmed: bool = False

    @property
    def spot(self) -> Point:
        """Where it stands, in metres; without an estimate the mean position."""
        at = self.estimate
        return (self.mean_x, self.mean_y) if at is None else (at.est_x, at.est_y)


@dataclass(frozen=True, slots=True)
class ObjectMove:
    """An Object that the fold found elsewhere; ``error_m`` is the distance's standard error."""

    before: ObjectRow
    after: ObjectRow
    error_m: float
    sure: bool

    @property
    def distance_m(self) -> float:
        """From where it stood to where it stands."""
        return math.dist(self.before.spot, self.after.spot)


@dataclass(frozen=True, slots=True)
class ObjectAbsence:
    """An Object that is missing in one of the two maps only: in the second one, unless it is
    ``back``."""

    before: ObjectRow
    after: ObjectRow
    back: bool
    sure: bool


@dataclass(frozen=True, slots=True)
class ObjectChanges:
    """``moved`` by distance, largest first; ``missing`` and those that are back. ``jitter`` counts
    other Objects whose estimate, or mean position, shifted within both errors, ``corrected`` those
    that shifted by more. ``joined`` are ids of Objects that are part of another one in the second
    map, with that one's id."""

    moved: tuple[ObjectMove, ...]
    missing: tuple[ObjectAbsence, ...]
    jitter: int
    corrected: int
    joined: Mapping[str, str]


def object_shift_m(before: ObjectRow, after: ObjectRow) -> float:
    """The distance in metres between the estimates of an Object; where one of them has none, that
    between the mean positions that it was seen from."""
    if before.estimate is None or after.estimate is None:
        return math.hypot(after.mean_x - before.mean_x, after.mean_y - before.mean_y)
    return math.dist(before.spot, after.spot)


def object_rows(view: MapView) -> dict[str, ObjectRow]:
    """The Objects of a map by id, in the order of the view."""
    ids = [place.place_id for place in view.all_places]
    det_ids = view.det_ids()
    return {
        o.object_id: ObjectRow(
            o.object_id,
            o.class_name,
            o.mean_x,
            o.mean_y,
            None if o.place is None else ids[o.place],
            o.first_seen,
            o.last_seen,
            tuple(det_ids[number] for number in o.observations),
            o.estimate,
            o.missing_in is not None,
            tuple(o.relocations),
            o.confirmed,
        )
        for o in view.objects.values()
    }


def became(
    first: MapView,
    second: MapView,
    before: Mapping[str, ObjectRow],
    after: Mapping[str, ObjectRow],
) -> ObjectChanges:
    """What became of the Objects of a map in another one; ``before`` and ``after`` are their
    `object_rows`."""
    ids, survivors = second.all_objects, second.object_survivors
    joined = {
        ids[number].object_id: ids[survivors.find(number)].object_id
        for number in survivors.absorbed_by
    }
    both = [(row, after[name]) for name, row in before.items() if name in after]
    changed = [pair for pair in both if pair[0] != pair[1]]
    is_forward = first.next_offset <= second.next_offset
    found = object_changes(before, after, changed, joined, is_forward=is_forward)
    earlier, later = (first, second) if is_forward else (second, first)
    records = [
        {each.object_id: each for each in view.objects.values()} if is_needed else {}
        for view, is_needed in ((earlier, found.moved), (later, found.missing))
    ]
    return replace(
        found,
        moved=tuple(
            replace(each, sure=_looked_again(earlier, later, records[0][each.before.object_id]))
            if each.sure
            else each
            for each in found.moved
        ),
        missing=tuple(
            each
            if not each.sure or each.back is is_forward
            else _checked(later, records[1][each.after.object_id], each)
            for each in found.missing
        ),
    )


def _looked_again(earlier: MapView, later: MapView, record: ObjectRecord) -> bool:
    """Whether a run of the later map, after those that saw an Object of the earlier one, looked at
    where it stood."""
    seen = list(earlier.sightings(record))
    until, runs = max(k.offset for k in seen), {k.run for k in seen}
    looking = keyframes_looking(earlier, record, later)
    return any(k.offset > until and k.run not in runs for k in looking)


def _checked(later: MapView, record: ObjectRecord, absence: ObjectAbsence) -> ObjectAbsence:
    """An absence of an Object of the later map, sure only if its keyframes leave no doubt."""
    seen = {keyframe.offset: keyframe for keyframe in later.sightings(record)}
    if any(keyframe.run == record.missing_in for keyframe in seen.values()):
        return replace(absence, sure=False)
    until = max(seen)
    looks = list(keyframes_looking(later, record, later))
    before = [keyframe for keyframe in looks if keyframe.offset <= until]
    hits = sum(keyframe.offset in seen for keyframe in before)
    is_usual = hits + 1 >= _SHARE * (len(before) + 2)
    since = [keyframe for keyframe in looks if keyframe.offset > until]
    return replace(absence, sure=is_usual and _turn(since, record.spot) >= _TURN)


def _turn(looks: Iterable[KeyframeRecord], spot: Point) -> float:
    """The angle that the lines of sight of some keyframes to a spot span; exact below 180°."""
    ways = [
        (spot[0] - k.pose.x_um / UM_PER_M, spot[1] - k.pose.y_um / UM_PER_M)
        for k in looks
        if k.pose
    ]
    turns = [
        math.atan2(ways[0][0] * y - ways[0][1] * x, ways[0][0] * x + ways[0][1] * y)
        for x, y in ways
    ]
    return max(turns, default=0.0) - min(turns, default=0.0)


def keyframes_looking(
    view: MapView, record: ObjectRecord, among: MapView
) -> Iterator[KeyframeRecord]:
    """The keyframes of ``among`` that should see an Object of ``view`` where it stands
    (`fold.presence`), in their order."""
    seen = [k for k in view.sightings(record) if k.pose is not None]
    floors = {k.floor for k in seen}
    vantages = {(k.pose.x_um / UM_PER_M, k.pose.y_um / UM_PER_M) for k in seen if k.pose}
    keyframes, (ordinals, spots) = among.once(keyframes_of), among.once(_by_position)
    similar = [similar_sights(spots, record.spot, vantage) for vantage in vantages]
    for number in np.unique(ordinals[np.concatenate([*similar, _NONE])]).tolist():
        keyframe = keyframes[number]
        if keyframe.pose is not None and keyframe.floor in floors:
            camera = camera_of(keyframe.camera, view.settings.camera)
            if would_see(keyframe.pose, camera, record.spot):
                yield keyframe


def keyframes_of(view: MapView) -> list[KeyframeRecord]:
    """All keyframes; a past map makes each one anew."""
    return list(view.keyframes)


def _by_position(view: MapView) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The ordinals of the keyframes that have a pose, ascending by x, and their positions in
    metres, shape (n, 2)."""
    poses = view.poses()
    order = np.argsort(poses.positions_um[:, 0], kind="stable")
    return poses.keyframes[order], poses.positions_um[order] / UM_PER_M


_NONE: Final = np.zeros(0, np.intp)


def object_changes(
    first: Mapping[str, ObjectRow],
    second: Mapping[str, ObjectRow],
    changed: Iterable[tuple[ObjectRow, ObjectRow]],
    joined: Mapping[str, str],
    *,
    is_forward: bool,
) -> ObjectChanges:
    """What became of the ``changed`` Objects; backwards, ``first`` is the later map."""
    later = _by_class(second if is_forward else first)
    moved: list[ObjectMove] = []
    missing: list[ObjectAbsence] = []
    jitter = corrected = 0
    for before, after in changed:
        old, new = (before, after) if is_forward else (after, before)
        is_relocated = any(each not in old.relocations for each in new.relocations)
        is_moved = is_relocated and not is_within(old.estimate, new.estimate)
        if is_moved:
            errors = [row.estimate.est_sigma_m for row in (old, new) if row.estimate is not None]
            is_sure = _is_sure(old, later, max(errors, default=math.inf))
            moved.append(ObjectMove(before, after, math.hypot(*errors), is_sure))
        if before.missing != after.missing:
            error = math.inf if old.estimate is None else old.estimate.est_sigma_m
            is_sure = _is_sure(old, later, error)
            missing.append(ObjectAbsence(before, after, before.missing, is_sure))
        if not is_moved and before.spot != after.spot:
            if is_within(before.estimate, after.estimate):
                jitter += 1
            else:
                corrected += 1
    moved.sort(key=lambda move: (-move.distance_m, move.before.object_id))
    return ObjectChanges(tuple(moved), tuple(missing), jitter, corrected, joined)


def _is_sure(old: ObjectRow, later: Mapping[str, list[ObjectRow]], error_m: float) -> bool:
    return error_m <= KNOWN_M and not any(
        other.object_id != old.object_id and is_within(old.estimate, other.estimate)
        for other in later.get(old.class_name, ())
    )


def _by_class(rows: Mapping[str, ObjectRow]) -> dict[str, list[ObjectRow]]:
    found: dict[str, list[ObjectRow]] = {}
    for row in rows.values():
        found.setdefault(row.class_name, []).append(row)
    return found


def is_within(one: EstimatedPosition | None, other: EstimatedPosition | None) -> bool:
    """Whether the errors of two estimates explain their distance; so for mean positions, whose
    shifts mean nothing."""
    if one is None or other is None:
        return True
    dx, dy = other.est_x - one.est_x, other.est_y - one.est_y
    sums = zip(one.covariance_m2, other.covariance_m2, strict=True)
    xx, xy, yy = (a + b for a, b in sums)
    return yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy <= _BEYOND * (xx * yy - xy * xy)


def object_document(row: ObjectRow) -> dict[str, Any]:
    """An Object as JSON, without its detections."""
    at = row.estimate
    return {
        "object_id": row.object_id,
        "class_name": row.class_name,
        "mean_x": row.mean_x,
        "mean_y": row.mean_y,
        "obs_count": len(row.det_ids),
        "place_id": row.place_id,
        **seen_times(row.first_seen, row.last_seen),
        "confirmed": row.confirmed,
        **(
            {}
            if at is None
            else {
                "est_x": at.est_x,
                "est_y": at.est_y,
                "est_sigma_m": at.est_sigma_m,
                "spots": at.spots,
                "missing": row.missing,
            }
        ),
    }


def changes_document(found: ObjectChanges) -> dict[str, Any]:
    """The moved, the missing and the found again as JSON, and the counts of other shifts."""
    return {
        "moved": [
            {
                "object_id": move.after.object_id,
                "class_name": move.after.class_name,
                "from": list(move.before.spot),
                "to": list(move.after.spot),
                "moved_m": move.distance_m,
                "error_m": move.error_m,
                "sure": move.sure,
            }
            for move in found.moved
        ],
        "missing": [_absence(each) for each in found.missing if not each.back],
        "back": [_absence(each) for each in found.missing if each.back],
        "shifted_within_error": found.jitter,
        "shifted_beyond_error": found.corrected,
    }


def _absence(found: ObjectAbsence) -> dict[str, Any]:
    return {
        "object_id": found.after.object_id,
        "class_name": found.after.class_name,
        "at": list(found.before.spot),
        "sure": found.sure,
    }
