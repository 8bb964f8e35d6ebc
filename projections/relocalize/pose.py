"""Poses the robot may be at, before they are weighed.

Three sources. Poses from which a landmark's observations were made. With a box, the circle around a
landmark at the crop's range, facing so that the box lies where it does. With two boxes, the one
pose that puts two landmarks where two crops show them (a rigid fit of two points, resection).

How well a pose explains the crops: a log-likelihood ratio against 'none of this is in the map'.

Crops are independent evidence given the pose, so their logs add. Each crop is explained by its best
landmark, or by none at a fixed price; that keeps one unknown or wrong crop from vetoing the others.
For a landmark three things count: the table of similarities at the direction from which the pose
looks at it, bearing and depth of the box against where the pose would see it, and whether it was
ever seen from about there (walls are not in the map, but what was seen from where is). Last, the
robot is where robots have driven.

From weighed hypotheses to one pose, its spread, and how much speaks for each Place.

Hypotheses are proposed unevenly, so each is weighed by its likelihood divided by how many others
lie within 0.3 m of it. The answer is the hypothesis with the least expected error, errors above 3 m
counting as 3 m (a median, not a mean: between two look-alike spots stands nothing), moved to the
mean of what lies within 1 m of it.

How sure: a logistic model on a few features of the posterior.

``confidence`` estimates the probability that the pose hypothesis is within 1.5 m (the default ε) of
the truth, counting a robot that is somewhere the map does not know as never right. The weights come
from `scripts/fit_confidence`, which fits them on generated buildings; the runs reported in
docs/relocalization.md were not used.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Floats
from .landmarks import DIRECTIONS, Landmark
from .model import Model
from .sighting import Sighting

_RING: Final = np.arange(24) * (2.0 * np.pi / 24)
_POSES_OF_LANDMARK: Final = 12
_MISFIT_M: Final = 1.0
"""Two landmarks whose distance differs by more from the crops' are not the pair seen."""


def propose(sightings: Sequence[Sighting]) -> Floats:
    """Poses of shape (h, 3): x, y in metres, yaw in radians; at least one per sighting."""
    parts: list[Floats] = []
    for sighting in sightings:
        for landmark in sighting.landmarks:
            parts.append(sighting.poses[landmark.members[:_POSES_OF_LANDMARK]])
            if sighting.bearing is not None:
                parts.append(_circle(sighting, landmark))
    boxed = [s for s in sightings if s.bearing is not None]
    resected = [pose for one, other in combinations(boxed, 2) for pose in _resect(one, other)]
    parts.append(np.array(resected, dtype=np.float64).reshape(-1, 3))
    return np.concatenate(parts)


def _circle(sighting: Sighting, landmark: Landmark) -> Floats:
    bearing = sighting.bearing or 0.0
    reach = sighting.depth / math.cos(bearing)
    return np.stack(
        (
            landmark.x + reach * np.cos(_RING),
            landmark.y + reach * np.sin(_RING),
            _RING + (np.pi - bearing),
        ),
        axis=1,
    )


def _resect(one: Sighting, other: Sighting) -> Iterator[tuple[float, float, float]]:
    (ax, ay), (bx, by) = one.in_robot_frame, other.in_robot_frame
    seen, seen_yaw = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
    for a in one.landmarks:
        for b in other.landmarks:
            dx, dy = b.x - a.x, b.y - a.y
            if a is b or abs(math.hypot(dx, dy) - seen) > _MISFIT_M:
                continue
            yaw = math.atan2(dy, dx) - seen_yaw
            cos, sin = math.cos(yaw), math.sin(yaw)
            mx, my = (ax + bx) / 2, (ay + by) / 2
            yield (
                (a.x + b.x) / 2 - (cos * mx - sin * my),
                (a.y + b.y) / 2 - (sin * mx + cos * my),
                yaw,
            )


_STEPS: Final = np.array(
    [(x, y, yaw) for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2) for yaw in (-0.07, 0.0, 0.07)]
)


def neighbours(poses: Floats) -> Floats:
    """Each pose and 26 around it: 0.2 m and 4° to every side."""
    around: Floats = (poses[:, None] + _STEPS[None]).reshape(-1, 3)
    return around


_IMPOSSIBLE: Final = -30.0
_TURN: Final = 2.0 * np.pi
_USUAL_DET: Final = (0.15 * 0.08) ** 2
"""The error ellipse of log depth and bearing against which a landmark is vague or sharp."""


def explain(sightings: Sequence[Sighting], poses: Floats, model: Model) -> tuple[Floats, Floats]:
    """(totals of shape (h,), shares of shape (crops, h)); the shares leave out the prior."""
    apart = [_squared(sighting.poses, poses) for sighting in sightings]
    shares = np.stack(
        [_explain_crop(s, poses, a, model) for s, a in zip(sightings, apart, strict=True)]
    )
    been = np.stack([a.min(0) for a in apart]).min(0)
    total: Floats = shares.sum(0) + np.maximum(-0.5 * been / model.driven**2, -model.driven_most)
    return total, shares


def _explain_crop(sighting: Sighting, poses: Floats, apart: Floats, model: Model) -> Floats:
    xs = np.array([landmark.x for landmark in sighting.landmarks])[:, None]
    ys = np.array([landmark.y for landmark in sighting.landmarks])[:, None]
    dx, dy = poses[None, :, 0] - xs, poses[None, :, 1] - ys
    reach, looking_from = np.sqrt(dx * dx + dy * dy), np.arctan2(dy, dx)
    fit = _table_lookup(sighting, looking_from)
    bearing = _wrap(looking_from + np.pi - poses[None, :, 2])
    if sighting.bearing is None:
        fit = fit + _in_view(bearing, reach, model)
    else:
        fit = fit + _box_fit(sighting, dx, dy, reach, bearing, model)
    fit = np.maximum(fit + _seen_from(sighting, apart, model), _IMPOSSIBLE)
    explained: Floats = np.logaddexp(0.0, fit.max(0) + model.unknown_price)
    return explained


def _table_lookup(sighting: Sighting, looking_from: Floats) -> Floats:
    tables = np.stack([landmark.table for landmark in sighting.landmarks])
    bins = np.rint(looking_from * (DIRECTIONS / _TURN)).astype(np.intp) % DIRECTIONS
    values: Floats = np.take_along_axis(tables, bins, axis=1)
    return values


def _box_fit(
    sighting: Sighting, dx: Floats, dy: Floats, reach: Floats, bearing: Floats, model: Model
) -> Floats:
    """A Gaussian in log depth and bearing, whose errors the landmark's place and size share."""
    a, b, c = _box_errors(sighting, dx, dy, reach, model)
    off = _wrap(bearing - (sighting.bearing or 0.0))
    depth = np.maximum(reach * np.maximum(np.cos(bearing), 0.1), 0.1)
    ratio = np.log(depth / sighting.depth)
    det = a * c - b * b
    chi = (c * ratio * ratio - 2.0 * b * ratio * off + a * off * off) / det
    fit: Floats = -0.5 * (chi + model.vague * np.log(det / _USUAL_DET))
    return fit


def _box_errors(
    sighting: Sighting, dx: Floats, dy: Floats, reach: Floats, model: Model
) -> tuple[Floats, Floats, Floats]:
    """Covariance of (log depth, bearing): log depth's variance, the mixed term, bearing's."""
    spreads = np.array([landmark.spread for landmark in sighting.landmarks])[:, :, None]
    slides = np.array([landmark.slide for landmark in sighting.landmarks])[:, :, None]
    r = np.maximum(reach, 0.6)
    ux, uy = -dx / r, -dy / r
    uxx, uxy, uyy, square = ux * ux, ux * uy, uy * uy, r * r
    xx, xy, yy = spreads[:, 0], spreads[:, 1], spreads[:, 2]
    skew = 2.0 * xy * uxy
    along = (xx * uxx + skew + yy * uyy) / square
    across = (xx * uyy - skew + yy * uxx) / square
    mixed = ((yy - xx) * uxy + xy * (uxx - uyy)) / square
    size = sighting.sigma_log_size**2
    outward = (slides[:, 0] * ux + slides[:, 1] * uy) / r - 1.0  # the crop's depth moves with it
    sideways = (slides[:, 1] * ux - slides[:, 0] * uy) / r
    depth = model.sigma_log_depth**2 + (model.sigma_log_depth_cut**2 if sighting.cut_y else 0.0)
    turn = model.sigma_bearing**2 + (model.sigma_bearing_cut**2 if sighting.cut_x else 0.0)
    return (
        along + size * outward * outward + depth,
        mixed + size * outward * sideways,
        across + size * sideways * sideways + turn,
    )


def _in_view(bearing: Floats, reach: Floats, model: Model) -> Floats:
    outside = np.maximum(np.abs(bearing) - model.half_view, 0.0) / 0.1
    far = (reach - model.usual_depth) / 1.2
    fit: Floats = -0.5 * (outside * outside + far * far)
    return fit


def _seen_from(sighting: Sighting, apart: Floats, model: Model) -> Floats:
    """Distance to the nearest pose that saw the landmark, as a penalty; shape (landmarks, h)."""
    members = [landmark.members for landmark in sighting.landmarks]
    starts = np.cumsum([0] + [len(m) for m in members[:-1]])
    squared = np.minimum.reduceat(apart[np.concatenate(members)], starts, axis=0)
    within = model.seen_from if sighting.bearing is not None else model.seen_from_no_box
    penalty: Floats = -0.5 * np.minimum(squared / within**2, 6.25)
    return penalty


def _squared(points: Floats, poses: Floats) -> Floats:
    """Squared distances in m², shape (points, h)."""
    dx = points[:, 0][:, None] - poses[None, :, 0]
    dy = points[:, 1][:, None] - poses[None, :, 1]
    squared: Floats = dx * dx + dy * dy
    return squared


def _wrap(angle: Floats) -> Floats:
    turned: NDArray[np.float64] = np.mod(angle + np.pi, _TURN) - np.pi
    return turned


_REFINED: Final = 16
_KEPT: Final = 200
_CROWD_M: Final = 0.3
_LOST_M: Final = 3.0
_NEAR_M: Final = 1.0
_SURE_OF_YAW: Final = 0.8


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """``poses`` (h, 3) with ``weights`` (h,) that add up to 1, likeliest first.

    ``x``, ``y`` and ``yaw`` (None when the evidence leaves it open) are the answer; ``spread_m``
    is the root mean square distance of all hypotheses from it, ``expected_error_m`` the mean
    distance with 3 m as the most, ``mass`` the weight within 1 m. ``total`` is the best
    hypothesis' log-likelihood ratio and ``shares`` its parts by crop, falling.
    """

    poses: Floats
    weights: Floats
    x: float
    y: float
    yaw: float | None
    spread_m: float
    expected_error_m: float
    mass: float
    total: float
    shares: tuple[float, ...]


def locate(sightings: Sequence[Sighting], model: Model) -> Posterior:
    """The posterior over poses; ``sightings`` must not be empty."""
    poses = propose(sightings)
    total, shares = explain(sightings, poses, model)
    around = neighbours(poses[_likeliest(total, _REFINED)])
    more_total, more_shares = explain(sightings, around, model)
    poses = np.concatenate((poses, around))
    total, shares = np.append(total, more_total), np.append(shares, more_shares, axis=1)
    kept = _likeliest(total, _KEPT)
    return _summary(poses[kept], total[kept], shares[:, kept[0]])


def _likeliest(total: Floats, count: int) -> "np.ndarray[tuple[int], np.dtype[np.intp]]":
    return np.argsort(-total, kind="stable")[:count]


def _summary(poses: Floats, total: Floats, shares: Floats) -> Posterior:
    dx = poses[:, 0][:, None] - poses[None, :, 0]
    dy = poses[:, 1][:, None] - poses[None, :, 1]
    apart = np.sqrt(dx * dx + dy * dy)
    weights = np.exp(total - total[0]) / (apart < _CROWD_M).sum(1)
    weights = weights / math.fsum(weights.tolist())
    expected = (np.minimum(apart, _LOST_M) * weights[None]).sum(1)
    best = int(np.argmin(expected))
    near = weights * (apart[best] < _NEAR_M)
    mass = float(near.sum())
    x, y = (float((poses[:, axis] * near).sum()) / mass for axis in (0, 1))
    squared = (poses[:, 0] - x) ** 2 + (poses[:, 1] - y) ** 2
    return Posterior(
        poses,
        weights,
        x,
        y,
        _yaw(poses[:, 2], near / mass),
        math.sqrt(float((squared * weights).sum())),
        float(expected[best]),
        mass,
        float(total[0]),
        tuple(sorted((float(share) for share in shares), reverse=True)),
    )


def _yaw(yaws: Floats, weights: Floats) -> float | None:
    """The circular mean in (-π, π], None when the yaws point everywhere."""
    sin, cos = float((np.sin(yaws) * weights).sum()), float((np.cos(yaws) * weights).sum())
    return math.atan2(sin, cos) if math.hypot(sin, cos) >= _SURE_OF_YAW else None


UNKNOWN_BELOW: Final = 0.3
"""Below this confidence the answer is 'unknown'."""

WEIGHTS: Final[tuple[float, ...]] = (-6.144, 0.159, 0.105, 0.740, 4.466, -0.776)
"""Intercept, then one weight for each of `features`."""


_MOST: Final = 7.0
"""A crop explains no more than this; keeps one lucky feature from deciding alone."""


def features(posterior: Posterior, crops: int) -> tuple[float, ...]:
    """What the confidence depends on; ``crops`` counts all crops asked with, at least 1."""
    shares = (*posterior.shares, 0.0, 0.0)
    return (
        min(shares[0], _MOST),
        min(shares[1], _MOST),
        min(posterior.total / crops, _MOST),
        posterior.mass,
        posterior.expected_error_m,
    )


def confidence(posterior: Posterior, crops: int) -> float:
    """A probability in 0 … 1."""
    score = WEIGHTS[0] + math.fsum(
        weight * value
        for weight, value in zip(WEIGHTS[1:], features(posterior, crops), strict=True)
    )
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, score))))
