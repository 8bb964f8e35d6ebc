"""How well a pose explains the crops: a log-likelihood ratio against 'none of this is in the map'.

Crops are independent evidence given the pose, so their logs add. Each crop is explained by its best
landmark, or by none at a fixed price; that keeps one unknown or wrong crop from vetoing the others.
For a landmark three things count: the table of similarities at the direction from which the pose
looks at it, bearing and depth of the box against where the pose would see it, and whether it was
ever seen from about there (walls are not in the map, but what was seen from where is). Last, the
robot is where robots have driven.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .camera import Floats
from .landmarks import DIRECTIONS
from .model import Model
from .sighting import Sighting

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
