"""Constants read off a map, each drawn towards its prior when few observations back it: ranges,
errors of bearings and poses, and sizes of classes, from triangulated things.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from projections.fold.evidence import EvidenceConstants

from .qualified_things import Flags, Floats, QualifiedThing, Sightings, inflation

PRIOR_COUNT = 100
"""The number of observations that a prior weighs as much as: a reading of n has the weight n/(n +
100)."""
_DIGITS = 4
_LEAST = 0.001
"""The least errors and spreads: no map is better than a millimetre or a milliradian."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A constant estimated from a map.

    ``value`` is the estimate to use, ``seen`` that of the map alone (None without evidence),
    ``prior`` the usual value, ``count`` the number of observations or pairs behind it.
    """

    name: str
    value: float | str | None
    seen: float | str | None
    prior: float | str | None
    count: int


def spread(name: str, seen: float, prior: float, count: int) -> Reading:
    """A reading of a quantity that is above 0: its logarithm is drawn towards the prior's."""
    if not count or not (math.isfinite(seen) and seen > 0.0):
        return unread(name, prior)
    share = count / (count + PRIOR_COUNT)
    value = math.exp(share * math.log(seen) + (1.0 - share) * math.log(prior))
    return Reading(name, max(rounded(value), _LEAST), rounded(seen), prior, count)


def level(name: str, seen: float, prior: float, count: int) -> Reading:
    """A reading of a quantity that may be negative."""
    if not count or not math.isfinite(seen):
        return unread(name, prior)
    share = count / (count + PRIOR_COUNT)
    value = share * seen + (1.0 - share) * prior
    return Reading(name, rounded(value), rounded(seen), prior, count)


def unread(name: str, prior: float | str | None) -> Reading:
    """The reading of a constant without evidence: the prior."""
    return Reading(name, prior, None, prior, 0)


def rounded(value: float) -> float:
    """Four significant digits, at most four decimals: machines whose logarithms differ in the last
    bit agree."""
    if value == 0.0:
        return 0.0
    decimals = _DIGITS - 1 - math.floor(math.log10(abs(value)))
    return round(value, max(0, min(decimals, _DIGITS))) + 0.0


LEAST_OF_A_CLASS = 4
_MAD = 1.4826
"""A normal distribution's standard deviation, in units of its median absolute deviation."""
_FEWEST_LEFT = 0.05
"""Share of an observation's variance that its residual must show for full weight; it shows less if
the leverage is nearly 1."""
_CAP = 25.0
"""Cap of squared residuals, in variances, which limits the effect of boxes of other things."""
_ROUNDS = 200
_PRIOR_RANGES = 7
_TO_PART = 10.0
_HINT_SIGMAS = 6.0
_HINT_LEAST = 0.06
_LEAST_INFORMATION = 1e-6
"""Least variation needed: boxes that are all in the middle of the picture are not informative."""


class Errors(NamedTuple):
    """Standard errors: of bearings, radians, and of poses, metres."""

    bearing: float
    bearing_cut: float
    pose: float


def ranges(things: Sequence[QualifiedThing], prior: EvidenceConstants) -> tuple[Reading, Reading]:
    """Median and spread of the distances."""
    if not things:
        return unread("range_m", prior.range_m), unread("range_spread", prior.range_spread)
    logs = np.log(np.concatenate([thing.range for thing in things]))
    middle = float(np.median(logs))
    return (
        spread("range_m", float(np.exp(middle)), prior.range_m, len(logs)),
        spread("range_spread", robust_spread(logs - middle), prior.range_spread, len(logs)),
    )


def errors(
    things: Sequence[QualifiedThing], seen: Sightings, prior: EvidenceConstants
) -> tuple[Reading, Reading, Reading]:
    """Errors of bearings, of cut ones, and of poses.

    Estimated from the distances between lines of sight and the thing: an error of the bearing grows
    with the range, one of the pose does not. If all ranges are similar the two cannot be separated,
    so pseudo-observations with only one of the three errors, of the prior's size, are added for
    each.
    """
    priors = Errors(prior.bearing_rad, prior.bearing_cut_rad, prior.pose_m)
    names = ("bearing_rad", "bearing_cut_rad", "pose_m")
    if not things:
        one, cut, pose = (unread(*pair) for pair in zip(names, priors, strict=True))
        return one, cut, pose
    distance = np.concatenate([thing.range for thing in things])
    residual = np.concatenate([thing.residual for thing in things])
    left = 1.0 - np.concatenate([thing.leverage for thing in things])
    cut_at = seen.cut[np.concatenate([thing.rows for thing in things])]
    past2 = (distance * np.sin(residual)) ** 2 / np.maximum(left, _FEWEST_LEFT)
    weight = np.clip(left / _FEWEST_LEFT, 0.0, 1.0)

    parts = np.stack([distance**2 * ~cut_at, distance**2 * cut_at, np.ones(len(distance))], axis=1)
    usual = _prior_ranges(prior) ** 2
    none, ones = np.zeros(len(usual)), np.ones(len(usual))
    alike = [(usual, none, none), (none, usual, none), (none, none, ones)]
    prior_parts = np.concatenate([np.stack(each, axis=1) for each in alike])
    found = _variances(
        np.concatenate([parts, prior_parts]),
        np.concatenate([past2, prior_parts @ np.square(priors)]),
        np.concatenate([weight, np.full(len(prior_parts), _TO_PART / len(usual))]),
        priors,
    )
    wider = inflation(things, seen, *found) ** 0.5
    counts = (int((~cut_at).sum()), int(cut_at.sum()), len(cut_at))
    one, cut, pose = (
        spread(name, value * wider, usually, count)
        for name, value, usually, count in zip(names, found, priors, counts, strict=True)
    )
    return one, cut, pose


def sizes(
    things: Sequence[QualifiedThing], seen: Sightings, prior: EvidenceConstants
) -> tuple[dict[str, Reading], Reading]:
    """The median height of each class's boxes, in metres, and the spread about it."""
    by_class: dict[str, list[tuple[float, int]]] = {}
    for thing in things:
        depth = thing.range * np.cos(seen.off_axis[thing.rows])
        metres = seen.height[thing.rows] * depth
        whole = metres > 0.0  # not NaN
        if whole.any():
            names = Counter(seen.classes[row] for row in thing.rows)
            name = min(names, key=lambda each: (-names[each], each))
            size = float(np.median(np.log(metres[whole])))
            by_class.setdefault(name, []).append((size, int(whole.sum())))
    found: dict[str, Reading] = {}
    about, freedom, boxes = 0.0, 0, 0
    for name, of_things in sorted(by_class.items()):
        logs = np.array([size for size, _ in of_things])
        count = sum(whole for _, whole in of_things)
        if count < LEAST_OF_A_CLASS:
            continue
        middle = float(np.median(logs))
        value = rounded(float(np.exp(middle)))
        found[name] = Reading(f"sizes_m.{name}", value, value, None, count)
        about += float(np.minimum((logs - middle) ** 2, _CAP * prior.size_spread**2).sum())
        freedom += len(logs) - 1
        boxes += len(logs)
    if not freedom:
        return found, unread("size_spread", prior.size_spread)
    return found, spread("size_spread", (about / freedom) ** 0.5, prior.size_spread, boxes)


def camera_faults(things: Sequence[QualifiedThing], seen: Sightings) -> list[Reading]:
    """Faults of the camera seen in bearings: the share by which they grow too fast from the middle
    of the picture to its side, and the angle by which all are off. Only significant ones."""
    if not things:
        return []
    rows = np.concatenate([thing.rows for thing in things])
    use: Flags = ~seen.cut[rows]
    residual = np.concatenate([thing.residual for thing in things])[use]
    axis = seen.off_axis[rows][use]
    if len(axis) < PRIOR_COUNT:
        return []
    design = np.stack([np.sin(axis) * np.cos(axis), np.ones(len(axis))], axis=1)
    weight = np.ones(len(axis))
    for _ in range(10):
        normal = design.T @ (design * weight[:, None]) + _LEAST_INFORMATION * np.eye(2)
        found = np.linalg.solve(normal, design.T @ (weight * residual))
        left = residual - design @ found
        sigma = max(robust_spread(left), 1e-6)
        weight = 1.0 / (1.0 + (left / (2.0 * sigma)) ** 2)
    error = sigma * np.sqrt(np.diag(np.linalg.inv(normal)))
    return [
        Reading(name, rounded(float(value)), rounded(float(value)), 0.0, len(axis))
        for name, value, off in zip(("hfov", "yaw_rad"), found, error, strict=True)
        if abs(value) > max(_HINT_LEAST, _HINT_SIGMAS * off)
    ]


def robust_spread(values: Floats) -> float:
    """The standard deviation by the median absolute value; of values about 0."""
    return float(_MAD * np.median(np.abs(values)))


def _variances(parts: Floats, squares: Floats, weight: Floats, start: Errors) -> Errors:
    """The components θ ≥ 0 of the variances parts · θ that the squares fit best (maximum
    likelihood of normal errors, squares capped), as standard errors."""
    theta = np.square(np.array(start))
    for _ in range(_ROUNDS):
        variance = parts @ theta
        capped = np.minimum(squares, _CAP * variance)
        up = parts.T @ (weight * capped / variance**2)
        down = parts.T @ (weight / variance)
        theta = theta * np.where(down > 0.0, up / np.where(down > 0.0, down, 1.0), 1.0)
        theta = np.maximum(theta, 1e-12)
    return Errors(*(float(value) for value in np.sqrt(theta)))


def _prior_ranges(prior: EvidenceConstants) -> Floats:
    """Distances as the prior expects them: evenly over two standard deviations each way."""
    steps = np.linspace(-2.0, 2.0, _PRIOR_RANGES)
    usual: Floats = prior.range_m * np.exp(prior.range_spread * steps)
    return usual
