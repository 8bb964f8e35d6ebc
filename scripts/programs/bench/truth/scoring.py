"""Scores of a view's Objects against true instances; pure."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from projections.fold.deltas import ObjectOrdinal, Pose
from projections.localize.evaluate.scores import agreement, instances_of
from projections.localize.evaluate.truth import Truth
from projections.map.records import ObjectRecord
from projections.map.view import MapView

from .worlds import TrueThing

LEAST_SEEN = 2
"""Observations: things and Objects with fewer are mostly phantoms, and are not counted."""
SPOT_M = 0.35
"""Poses closer than this are of one spot."""
SIGMAS = 2.0
_M = 1e-6


@dataclass(frozen=True, slots=True)
class ObjectScores:
    """``instances`` true things seen twice or more, ``objects`` Objects with two observations or
    more; V and adjusted Rand of observations in Objects against instances.

    ``errors_m`` are distances from estimate to truth of Objects that were seen from two spots or
    more, and ``inside`` how many of these lie within the stated 2σ ellipse about the estimate.
    """

    instances: int
    objects: int
    v_measure: float
    adjusted_rand: float
    errors_m: tuple[float, ...]
    inside: int

    @property
    def ratio(self) -> float:
        """Objects found for each true thing."""
        return self.objects / self.instances if self.instances else math.nan

    @property
    def median_error_m(self) -> float:
        """The upper median; NaN for none."""
        errors = sorted(self.errors_m)
        return errors[len(errors) // 2] if errors else math.nan

    @property
    def inside_share(self) -> float:
        """NaN for none."""
        return self.inside / len(self.errors_m) if self.errors_m else math.nan


def score_objects(view: MapView, truth: Truth, things: Mapping[str, TrueThing]) -> ObjectScores:
    """Score all Objects of a view."""
    pairs = [
        (instance, thing)
        for observation, instance in instances_of(view, truth)
        if instance is not None and (thing := view.observations[observation].object) is not None
    ]
    seen = Counter(instance for instance, _ in pairs)
    scores = agreement([instance for instance, _ in pairs], [thing for _, thing in pairs])
    owners = majorities(view, truth)
    errors, inside = [], 0
    for ordinal, record in view.objects.items():
        thing = things.get(owners.get(ordinal, ""))
        estimate = record.estimate
        if thing is None or estimate is None or spots_of(view, record) < LEAST_SEEN:
            continue
        dx, dy = estimate.x_um * _M - thing.x, estimate.y_um * _M - thing.y
        errors.append(math.hypot(dx, dy))
        covariance = (estimate.var_xx_um2, estimate.var_xy_um2, estimate.var_yy_um2)
        inside += is_inside(dx, dy, *(v * _M**2 for v in covariance))
    return ObjectScores(
        sum(n >= LEAST_SEEN for n in seen.values()),
        sum(record.obs_count >= LEAST_SEEN for record in view.objects.values()),
        scores.v_measure,
        scores.adjusted_rand,
        tuple(errors),
        inside,
    )


def majorities(view: MapView, truth: Truth) -> dict[ObjectOrdinal, str]:
    """The instance of most of each Object's observations; ties go to the first by name. Objects of
    false positives alone are left out."""
    counts: dict[ObjectOrdinal, Counter[str]] = {}
    for observation, instance in instances_of(view, truth):
        thing = view.observations[observation].object
        if instance is not None and thing is not None:
            counts.setdefault(thing, Counter())[instance] += 1
    return {thing: max(sorted(c), key=c.__getitem__) for thing, c in counts.items()}


def spots_of(view: MapView, record: ObjectRecord) -> int:
    """From how many spots an Object was seen: poses that are ``SPOT_M`` from all earlier spots."""
    poses = (view.keyframes[view.observations[o].keyframe].pose for o in record.observations)
    return count_spots(pose for pose in poses if pose is not None)


def count_spots(poses: Iterable[Pose]) -> int:
    """Poses that are ``SPOT_M`` or more from all spots before them found a spot."""
    spots: list[tuple[float, float]] = []
    for pose in poses:
        at = pose.x_m, pose.y_m
        if all(math.dist(at, spot) >= SPOT_M for spot in spots):
            spots.append(at)
    return len(spots)


def is_inside(dx: float, dy: float, xx: float, xy: float, yy: float) -> bool:
    """Whether an offset is within the 2σ ellipse of a covariance, the border included."""
    determinant = xx * yy - xy * xy
    if determinant <= 0.0:
        raise ValueError(f"no covariance: xx={xx}, xy={xy}, yy={yy}")
    squared = (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant
    return squared <= SIGMAS**2
