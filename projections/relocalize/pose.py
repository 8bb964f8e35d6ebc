"""Poses: propose where the robot may be, score each against the crops, and choose.

Proposed are the poses from which a landmark's observations were made; for a crop with a box, poses
on the circle around a landmark at the crop's range, turned so that the landmark is at the box's
bearing; for two crops with boxes, the pose that puts two landmarks where the crops show them
(resection: a rigid fit of two points).

The score is a log-likelihood ratio against 'none of this is in the map'. Crops are independent
evidence given the pose, so their logs add. Each crop is explained by its best landmark, or by none
at a fixed price, so one unknown or wrong crop does not outvote the others. For a landmark three
things count: its table of similarities at the direction from which the pose looks at it; bearing
and depth of the box against where the pose would see it; and how far the pose is from the nearest
one that saw it, which stands in for walls, as they are not in the map. A prior favours poses near
those of the matches: robots have driven there.

Poses are proposed unevenly, so each weighs its likelihood divided by how many lie within 0.3 m of
it. The answer is the pose with the least expected error, errors above 3 m counting as 3 m (like a
median; a mean could lie between two look-alike spots), moved to the mean of the poses within 1 m.

The confidence is a logistic model on a few features of these weights: the probability that the pose
is within 1.5 m (the default ε) of the truth. A robot outside the mapped area counts as never right.
Its weights come from `scripts/fit_confidence`, which fits them on generated buildings; the runs
reported in docs/relocalization.md were not used.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Camera, Floats
from .candidates import Match
from .landmarks import DIRECTIONS, CropEvidence, LandmarkHypothesis, crop_evidence
from .model import Model
from .question import Crop

_TURN: Final = 2.0 * np.pi
_CIRCLE: Final = np.arange(24) * (_TURN / 24)
_POSES_OF_LANDMARK: Final = 12
_MAX_MISFIT_M: Final = 1.0
"""Two landmarks are paired with two crops only if their distances differ by at most this."""
_STEPS: Final = np.array(
    [(x, y, yaw) for x in (-0.2, 0.0, 0.2) for y in (-0.2, 0.0, 0.2) for yaw in (-0.07, 0.0, 0.07)]
)
_REFINED: Final = 16
_KEPT: Final = 200
_MIN_FIT: Final = -30.0
_USUAL_DET: Final = (0.15 * 0.08) ** 2
"""The usual determinant of the covariance of log depth and bearing: a landmark with a larger one
scores less (`Model.vague`)."""
_DENSITY_RADIUS_M: Final = 0.3
_MAX_ERROR_M: Final = 3.0
_NEAR_M: Final = 1.0
_MIN_YAW_AGREEMENT: Final = 0.8

WEIGHTS: Final[tuple[float, ...]] = (-6.144, 0.159, 0.105, 0.740, 4.466, -0.776)
"""Weights of the confidence: intercept, then one for each of `Posterior.features`."""
_MAX_FEATURE: Final = 7.0
"""Upper limit of the first three features, so that none decides alone."""


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """``poses`` (h, 3) with ``weights`` (h,) that add up to 1, likeliest first.

    ``x``, ``y`` and ``yaw`` (None when the evidence leaves it open) are the answer; ``spread_m``
    is the root mean square distance of all poses from it. ``confidence`` is computed from
    ``features``: the largest and second largest share of a crop in the best pose's log-likelihood
    ratio, that ratio per crop, the weight within 1 m of the answer, and the mean distance from it
    with 3 m as the most.
    """

    poses: Floats
    weights: Floats
    x: float
    y: float
    yaw: float | None
    spread_m: float
    features: tuple[float, ...]
    confidence: float


def locate(
    crops: Sequence[Crop], matches: Sequence[Sequence[Match]], camera: Camera, model: Model
) -> Posterior | None:
    """The posterior over poses; ``matches`` run parallel to ``crops``. None if none is relevant."""
    evidence = crop_evidence(crops, matches, camera, model)
    if not evidence:
        return None
    poses = _propose(evidence)
    total, shares = _score(evidence, poses, model)
    around = _grid_around(poses[_likeliest(total, _REFINED)])
    more_total, more_shares = _score(evidence, around, model)
    poses = np.concatenate((poses, around))
    total, shares = np.append(total, more_total), np.append(shares, more_shares, axis=1)
    kept = _likeliest(total, _KEPT)
    return _choose(poses[kept], total[kept], shares[:, kept[0]], len(crops))


def _likeliest(total: Floats, count: int) -> "np.ndarray[tuple[int], np.dtype[np.intp]]":
    return np.argsort(-total, kind="stable")[:count]


def _propose(evidence: Sequence[CropEvidence]) -> Floats:
    """Poses of shape (h, 3): x, y in metres, yaw in radians; at least one for each crop."""
    parts: list[Floats] = []
    for crop in evidence:
        for landmark in crop.landmarks:
            parts.append(crop.poses[landmark.members[:_POSES_OF_LANDMARK]])
            if crop.bearing is not None:
                parts.append(_circle(crop, landmark))
    boxed = [crop for crop in evidence if crop.bearing is not None]
    resected = [pose for one, other in combinations(boxed, 2) for pose in _resect(one, other)]
    parts.append(np.array(resected, dtype=np.float64).reshape(-1, 3))
    return np.concatenate(parts)


def _circle(crop: CropEvidence, landmark: LandmarkHypothesis) -> Floats:
    bearing = crop.bearing or 0.0
    reach = crop.depth / math.cos(bearing)
    return np.stack(
        (
            landmark.x + reach * np.cos(_CIRCLE),
            landmark.y + reach * np.sin(_CIRCLE),
            _CIRCLE + (np.pi - bearing),
        ),
        axis=1,
    )


def _resect(one: CropEvidence, other: CropEvidence) -> Iterator[tuple[float, float, float]]:
    (ax, ay), (bx, by) = _in_robot_frame(one), _in_robot_frame(other)
    seen, seen_yaw = math.hypot(bx - ax, by - ay), math.atan2(by - ay, bx - ax)
    for a in one.landmarks:
        for b in other.landmarks:
            dx, dy = b.x - a.x, b.y - a.y
            if a is b or abs(math.hypot(dx, dy) - seen) > _MAX_MISFIT_M:
                continue
            yaw = math.atan2(dy, dx) - seen_yaw
            cos, sin = math.cos(yaw), math.sin(yaw)
            mx, my = (ax + bx) / 2, (ay + by) / 2
            yield (
                (a.x + b.x) / 2 - (cos * mx - sin * my),
                (a.y + b.y) / 2 - (sin * mx + cos * my),
                yaw,
            )


def _in_robot_frame(crop: CropEvidence) -> tuple[float, float]:
    """Metres ahead and left of the robot; only for a crop with a box."""
    return crop.depth, crop.depth * math.tan(crop.bearing or 0.0)


def _grid_around(poses: Floats) -> Floats:
    """Each pose and 26 around it: 0.2 m and 4° to every side."""
    around: Floats = (poses[:, None] + _STEPS[None]).reshape(-1, 3)
    return around


def _score(evidence: Sequence[CropEvidence], poses: Floats, model: Model) -> tuple[Floats, Floats]:
    """(totals of shape (h,), shares of shape (crops, h)); the shares leave out the prior."""
    apart = [_squared_distances(crop.poses, poses) for crop in evidence]
    shares = np.stack(
        [_score_crop(crop, poses, a, model) for crop, a in zip(evidence, apart, strict=True)]
    )
    been = np.stack([a.min(0) for a in apart]).min(0)
    total: Floats = shares.sum(0) + np.maximum(-0.5 * been / model.driven**2, -model.driven_most)
    return total, shares


def _score_crop(crop: CropEvidence, poses: Floats, apart: Floats, model: Model) -> Floats:
    xs = np.array([landmark.x for landmark in crop.landmarks])[:, None]
    ys = np.array([landmark.y for landmark in crop.landmarks])[:, None]
    dx, dy = poses[None, :, 0] - xs, poses[None, :, 1] - ys
    reach, looking_from = np.sqrt(dx * dx + dy * dy), np.arctan2(dy, dx)
    fit = _similarity_fit(crop, looking_from)
    bearing = _wrap(looking_from + np.pi - poses[None, :, 2])
    if crop.bearing is None:
        fit = fit + _view_fit(bearing, reach, model)
    else:
        fit = fit + _box_fit(crop, dx, dy, reach, bearing, model)
    fit = np.maximum(fit + _visibility_fit(crop, apart, model), _MIN_FIT)
    explained: Floats = np.logaddexp(0.0, fit.max(0) + model.unknown_price)
    return explained


def _similarity_fit(crop: CropEvidence, looking_from: Floats) -> Floats:
    """Each landmark's table at the direction from which each pose looks at it."""
    tables = np.stack([landmark.table for landmark in crop.landmarks])
    bins = np.rint(looking_from * (DIRECTIONS / _TURN)).astype(np.intp) % DIRECTIONS
    values: Floats = np.take_along_axis(tables, bins, axis=1)
    return values


def _box_fit(
    crop: CropEvidence, dx: Floats, dy: Floats, reach: Floats, bearing: Floats, model: Model
) -> Floats:
    """A Gaussian in log depth and bearing, whose errors the landmark's position and size share."""
    a, b, c = _box_errors(crop, dx, dy, reach, model)
    off = _wrap(bearing - (crop.bearing or 0.0))
    depth = np.maximum(reach * np.maximum(np.cos(bearing), 0.1), 0.1)
    ratio = np.log(depth / crop.depth)
    det = a * c - b * b
    chi = (c * ratio * ratio - 2.0 * b * ratio * off + a * off * off) / det
    fit: Floats = -0.5 * (chi + model.vague * np.log(det / _USUAL_DET))
    return fit


def _box_errors(
    crop: CropEvidence, dx: Floats, dy: Floats, reach: Floats, model: Model
) -> tuple[Floats, Floats, Floats]:
    """Covariance of (log depth, bearing): log depth's variance, the mixed term, bearing's."""
    spreads = np.array([landmark.spread for landmark in crop.landmarks])[:, :, None]
    slides = np.array([landmark.slide for landmark in crop.landmarks])[:, :, None]
    r = np.maximum(reach, 0.6)
    ux, uy = -dx / r, -dy / r
    uxx, uxy, uyy, square = ux * ux, ux * uy, uy * uy, r * r
    xx, xy, yy = spreads[:, 0], spreads[:, 1], spreads[:, 2]
    skew = 2.0 * xy * uxy
    along = (xx * uxx + skew + yy * uyy) / square
    across = (xx * uyy - skew + yy * uxx) / square
    mixed = ((yy - xx) * uxy + xy * (uxx - uyy)) / square
    size = crop.sigma_log_size**2
    outward = (slides[:, 0] * ux + slides[:, 1] * uy) / r - 1.0  # the crop's depth moves with it
    sideways = (slides[:, 1] * ux - slides[:, 0] * uy) / r
    depth = model.sigma_log_depth**2 + (model.sigma_log_depth_cut**2 if crop.cut_y else 0.0)
    turn = model.sigma_bearing**2 + (model.sigma_bearing_cut**2 if crop.cut_x else 0.0)
    return (
        along + size * outward * outward + depth,
        mixed + size * outward * sideways,
        across + size * sideways * sideways + turn,
    )


def _view_fit(bearing: Floats, reach: Floats, model: Model) -> Floats:
    """For a crop without a box: the landmark is in view, at a usual distance."""
    outside = np.maximum(np.abs(bearing) - model.half_view, 0.0) / 0.1
    far = (reach - model.usual_depth) / 1.2
    fit: Floats = -0.5 * (outside * outside + far * far)
    return fit


def _visibility_fit(crop: CropEvidence, apart: Floats, model: Model) -> Floats:
    """Distance to the nearest pose that saw the landmark, as a penalty; shape (landmarks, h)."""
    members = [landmark.members for landmark in crop.landmarks]
    starts = np.cumsum([0] + [len(m) for m in members[:-1]])
    squared = np.minimum.reduceat(apart[np.concatenate(members)], starts, axis=0)
    within = model.seen_from if crop.bearing is not None else model.seen_from_no_box
    penalty: Floats = -0.5 * np.minimum(squared / within**2, 6.25)
    return penalty


def _squared_distances(points: Floats, poses: Floats) -> Floats:
    """In m², of shape (points, h)."""
    dx = points[:, 0][:, None] - poses[None, :, 0]
    dy = points[:, 1][:, None] - poses[None, :, 1]
    squared: Floats = dx * dx + dy * dy
    return squared


def _wrap(angle: Floats) -> Floats:
    turned: NDArray[np.float64] = np.mod(angle + np.pi, _TURN) - np.pi
    return turned


def _choose(poses: Floats, total: Floats, shares: Floats, crops: int) -> Posterior:
    """Weigh the poses and choose one.

    ``shares`` are the likeliest pose's, one for each crop with evidence; ``crops`` counts all.
    """
    apart = np.sqrt(_squared_distances(poses, poses))
    weights = np.exp(total - total[0]) / (apart < _DENSITY_RADIUS_M).sum(1)
    weights = weights / math.fsum(weights.tolist())
    expected = (np.minimum(apart, _MAX_ERROR_M) * weights[None]).sum(1)
    best = int(np.argmin(expected))
    near = weights * (apart[best] < _NEAR_M)
    mass = float(near.sum())
    x, y = (float((poses[:, axis] * near).sum()) / mass for axis in (0, 1))
    squared = (poses[:, 0] - x) ** 2 + (poses[:, 1] - y) ** 2
    first, second, *_ = *sorted((float(share) for share in shares), reverse=True), 0.0
    features = (
        min(first, _MAX_FEATURE),
        min(second, _MAX_FEATURE),
        min(float(total[0]) / crops, _MAX_FEATURE),
        mass,
        float(expected[best]),
    )
    return Posterior(
        poses,
        weights,
        x,
        y,
        _mean_yaw(poses[:, 2], near / mass),
        math.sqrt(float((squared * weights).sum())),
        features,
        _confidence(features),
    )


def _mean_yaw(yaws: Floats, weights: Floats) -> float | None:
    """The circular mean in (-π, π], None when the yaws disagree."""
    sin, cos = float((np.sin(yaws) * weights).sum()), float((np.cos(yaws) * weights).sum())
    return math.atan2(sin, cos) if math.hypot(sin, cos) >= _MIN_YAW_AGREEMENT else None


def _confidence(features: Sequence[float]) -> float:
    """A probability in 0 … 1."""
    score = WEIGHTS[0] + math.fsum(
        weight * value for weight, value in zip(WEIGHTS[1:], features, strict=True)
    )
    return 1.0 / (1.0 + math.exp(-max(-40.0, min(40.0, score))))
