"""From weighed hypotheses to one pose, its spread, and how much speaks for each Place.

Hypotheses are proposed unevenly, so each is weighed by its likelihood divided by how many others
lie within 0.3 m of it. The answer is the hypothesis with the least expected error, errors above 3 m
counting as 3 m (a median, not a mean: between two look-alike spots stands nothing), moved to the
mean of what lies within 1 m of it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from .camera import Floats
from .hypotheses import neighbours, propose
from .likelihood import explain
from .model import Model
from .sighting import Sighting

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
