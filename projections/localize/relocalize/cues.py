"""Cues: the evidence of boxes for the distance of a landmark.

Two quantities of a landmark, each the mean over the observations whose boxes the picture's border
does not cut there:

size        logarithm of the box's height in metres, log(height at 1 m) + log(distance)
elevation   of the upper or lower edge above the camera: rise of the line of sight × distance

Both are computed from the estimated position, so they contain its error; each comes with its
gradient with respect to the position. A thing seen from one spot may be farther away than
estimated, but then it is larger, too, and looks the same from that spot.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from projections.fold.evidence import EvidenceConstants

from .camera import LOWER, UPPER, Floats, Sights
from .model import Model

Indices = NDArray[np.intp]

_NEAREST_M: Final = 0.3
_PRIOR_EDGES: Final = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Cue:
    """A quantity of n landmarks, its gradient with respect to their position, and its variance at a
    given position, infinite where nothing is known."""

    mean: Floats
    by_x: Floats
    by_y: Floats
    variance: Floats

    def part(self, rows: slice) -> "Cue":
        """The cue of some of the landmarks."""
        return Cue(self.mean[rows], self.by_x[rows], self.by_y[rows], self.variance[rows])


def cues(
    boxes: Sights, poses: Floats, sight: Floats, at: Floats, starts: Indices, model: Model
) -> tuple[Cue, tuple[Cue, Cue]]:
    """The cues of landmarks: size, and the elevations of the upper and the lower edge. Of each
    observation, ``at`` (m, 2) is the position of its landmark and ``sight`` (m,) its direction in
    the map."""
    ux, uy = np.cos(sight), np.sin(sight)
    ahead = (at[:, 0] - poses[:, 0]) * ux + (at[:, 1] - poses[:, 1]) * uy
    ahead = np.maximum(ahead, _NEAREST_M)
    per = 1.0 / ahead
    tall = boxes.tall.astype(np.float64)
    size, _, count = _mean_cue(boxes.log_height + np.log(ahead), ux * per, uy * per, tall, starts)
    size = Cue(
        size.mean, size.by_x, size.by_y, np.where(count > 0.0, model.size_spread**2, math.inf)
    )
    edges = []
    for edge in (UPPER, LOWER):
        rise, whole = boxes.rise[edge], boxes.whole[edge].astype(np.float64)
        cue, scatter, count = _mean_cue(rise * ahead, rise * ux, rise * uy, whole, starts)
        part = model.edge_part * cue.mean
        prior = _PRIOR_EDGES * (model.edge_m**2 + part * part)
        variance = np.where(count > 0.0, (scatter + prior) / (count + _PRIOR_EDGES), math.inf)
        edges.append(Cue(cue.mean, cue.by_x, cue.by_y, variance))
    return size, (edges[0], edges[1])


def _mean_cue(
    value: Floats, by_x: Floats, by_y: Floats, weight: Floats, starts: Indices
) -> tuple[Cue, Floats, Floats]:
    """Weighted means over each landmark's observations, the sum of squared deviations, and the
    weight; the variance is left 0."""
    count = np.add.reduceat(weight, starts)
    safe = np.maximum(count, 1e-9)
    rows = np.stack((value, value * value, by_x, by_y)) * weight
    mean, square, x, y = np.add.reduceat(rows, starts, axis=1) / safe
    scatter = np.maximum(square - mean * mean, 0.0) * count
    return Cue(mean, x, y, np.zeros_like(mean)), scatter, count


def with_class_sizes(
    size: Cue, classes: Sequence[str], evidence: EvidenceConstants, model: Model
) -> Cue:
    """``size``, with the known size of the class for landmarks that have no box with a height."""
    mean, variance = size.mean.copy(), size.variance.copy()
    for index in np.flatnonzero(~np.isfinite(variance)).tolist():
        height = evidence.sizes_m.get(classes[index])
        if height is not None:
            mean[index] = math.log(height)
            variance[index] = evidence.size_spread**2 + model.size_spread**2
    return Cue(mean, size.by_x, size.by_y, variance)
