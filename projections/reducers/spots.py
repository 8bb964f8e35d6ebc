"""Where a thing stands: the estimate from its sights, and how sure it is.

Sights from one spot (closer than `SPOT_M`) share their errors: twelve views from one pose are no
triangulation. So a spot keeps the mean of its sights, and they weigh min(n, 1.5) together. Of all
spots, what is known beforehand about the range is shared too and weighs 1.5 spots together.

The unknowns are the position p, the logarithm z of the thing's height, and its elevation e above
the camera. At the distance a from a spot,

    bearing     0 = across / a                   variance (bearing error)² + (pose error / a)²
    range       log a = log(usual range)         (range_spread)²
    box height  log a + log(height / f) = z      _SIZE², where the border does not cut it
    its centre  a · slope = e                    (_SLOPE a)² + 2 cm²; a level camera
    measured    a = depth                        that of the depth or position

z and e start from what their class is like (`class_heights`). Driving towards a thing, its growing
box tells its distance as a change of bearing does. Gauss-Newton in information form; z and e are
eliminated (Schur's complement). A residual beyond about two standard errors weighs less (Cauchy).
+, −, ×, ÷ in one fixed order: the same bits on every machine.
"""

import math
from typing import NamedTuple

from projections.exact_functions import log

from .class_heights import HeightPrior
from .sights import Sight

SPOT_M = 0.35
MAX_SPOTS = 12
LEAST_M = 0.3
SIZE = 0.15
SLOPE = 0.02
LEAST_ELEVATION_M2 = 0.0004
_TOGETHER = 1.5
_TAIL = 4.0
_FIRST_ROUNDS = 3
_ROUNDS = 2
_WEIGHT, _COUNT, _HEIGHT, _HEIGHTS, _SLOPED, _DEPTH, _DEPTH_WEIGHT = range(6, 13)

Spot = list[float]
"""Means of x, y, cos, sin, across_per_m2, across_m2 of its sights, weighed by the precision of the
bearing; that weight; number of sights; mean log height, their number, mean slope; mean measured
distance, its precision."""


class Estimate(NamedTuple):
    """Position, metres, and its covariance, m²; log size and elevation with their gradients by
    position and their variances at a given position."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    log_size: float
    log_size_x: float
    log_size_y: float
    log_size_variance: float
    elevation: float
    elevation_x: float
    elevation_y: float
    elevation_variance: float


class Spots:
    """The spots that a thing was seen from, the number of spots ever."""

    __slots__ = ("seen_from", "spots")

    def __init__(self, spots: list[Spot] | None = None, seen_from: int = 0) -> None:
        self.spots: list[Spot] = [] if spots is None else spots
        self.seen_from = seen_from

    def add(self, sight: Sight) -> None:
        """Take in a sight."""
        weight = 1.0 / (sight.across_per_m2 + sight.across_m2)
        height, heights = (0.0, 0.0) if sight.log_height is None else (sight.log_height, 1.0)
        depth, depth_weight = (0.0, 0.0)
        if sight.measured is not None:
            depth, depth_weight = sight.measured[0], 1.0 / sight.measured[1]
        spot = [*sight[:6], weight, 1.0, height, heights, sight.slope, depth, depth_weight]
        self._take(spot)

    def take_in(self, other: "Spots") -> None:
        """Take in the spots of another thing, which has turned out to be the same."""
        for spot in other.spots:
            self._take(spot)

    def _take(self, new: Spot) -> None:
        nearest, best = None, SPOT_M * SPOT_M
        for spot in self.spots:
            dx, dy = spot[0] - new[0], spot[1] - new[1]
            far = dx * dx + dy * dy
            if far < best:
                nearest, best = spot, far
        if nearest is None:
            self.seen_from += 1
            self.spots.append(new)
            if len(self.spots) > MAX_SPOTS:
                del self.spots[1]  # the first one holds the view that founded the thing
            return
        total = nearest[_WEIGHT] + new[_WEIGHT]
        share = new[_WEIGHT] / total
        for index in range(_WEIGHT):
            nearest[index] += (new[index] - nearest[index]) * share
        length = math.sqrt(nearest[2] * nearest[2] + nearest[3] * nearest[3])
        if length > 0.0:
            nearest[2] /= length
            nearest[3] /= length
        nearest[_WEIGHT] = total
        nearest[_COUNT] += new[_COUNT]
        if new[_HEIGHTS] > 0.0:
            nearest[_HEIGHTS] += new[_HEIGHTS]
            share = new[_HEIGHTS] / nearest[_HEIGHTS]
            nearest[_HEIGHT] += (new[_HEIGHT] - nearest[_HEIGHT]) * share
            nearest[_SLOPED] += (new[_SLOPED] - nearest[_SLOPED]) * share
        if new[_DEPTH_WEIGHT] > 0.0:
            nearest[_DEPTH_WEIGHT] += new[_DEPTH_WEIGHT]
            share = new[_DEPTH_WEIGHT] / nearest[_DEPTH_WEIGHT]
            nearest[_DEPTH] += (new[_DEPTH] - nearest[_DEPTH]) * share


class Solver:
    """Solves for the estimate; ``range_m`` and ``range_spread`` as in the constants."""

    def __init__(self, range_m: float, range_spread: float) -> None:
        self._range_m = range_m
        self._log_range = log(range_m)
        self._range_weight = 1.0 / (range_spread * range_spread)

    def solve(self, spots: list[Spot], prior: HeightPrior, before: Estimate | None) -> Estimate:
        """The estimate, starting from the one before, or from the first spot's."""
        rounds = _ROUNDS
        if before is not None:
            x, y = before.x, before.y
        else:
            first, rounds = spots[0], _FIRST_ROUNDS
            start = first[_DEPTH] if first[_DEPTH_WEIGHT] > 0.0 else self._range_m
            x, y = first[0] + start * first[2], first[1] + start * first[3]
        count = len(spots)
        range_weight = self._range_weight
        if count > _TOGETHER:
            range_weight *= _TOGETHER / count
        size_weight = 1.0 / (SIZE * SIZE)
        log_range = self._log_range
        z_mean, z_prior, e_mean, e_prior = prior
        for _ in range(rounds):
            xx = xy = yy = bx = by = 0.0
            zw, zx, zy, zr = z_prior, 0.0, 0.0, z_prior * z_mean
            ew, ex, ey, er = e_prior, 0.0, 0.0, e_prior * e_mean
            for px, py, cos, sin, ak, a0, _, n, height, heights, slope, depth, dw in spots:
                dx, dy = x - px, y - py
                along, across = dx * cos + dy * sin, dy * cos - dx * sin
                if along < LEAST_M:
                    along = LEAST_M
                variance = ak * along * along + a0
                w = (min(_TOGETHER, n)) / variance
                w /= 1.0 + across * across / (variance * _TAIL)
                xx += w * sin * sin
                xy -= w * sin * cos
                yy += w * cos * cos
                bx += w * sin * across
                by -= w * cos * across
                log_along = log(along)
                gx, gy = cos / along, sin / along
                residual = log_range - log_along
                xx += range_weight * gx * gx
                xy += range_weight * gx * gy
                yy += range_weight * gy * gy
                bx += range_weight * gx * residual
                by += range_weight * gy * residual
                if dw > 0.0:
                    residual = depth - along
                    xx += dw * cos * cos
                    xy += dw * cos * sin
                    yy += dw * sin * sin
                    bx += dw * cos * residual
                    by += dw * sin * residual
                if heights > 0.0:
                    share = min(_TOGETHER, heights)
                    value = height + log_along
                    w = size_weight * share
                    if zw > z_prior:
                        residual = value - zr / zw
                        w /= 1.0 + residual * residual * w / _TAIL
                    xx += w * gx * gx
                    xy += w * gx * gy
                    yy += w * gy * gy
                    bx -= w * gx * value
                    by -= w * gy * value
                    zw += w
                    zx += w * gx
                    zy += w * gy
                    zr += w * value
                    value = along * slope
                    w = share / (SLOPE * SLOPE * along * along + LEAST_ELEVATION_M2)
                    if ew > e_prior:
                        residual = value - er / ew
                        w /= 1.0 + residual * residual * w / _TAIL
                    gx, gy = slope * cos, slope * sin
                    xx += w * gx * gx
                    xy += w * gx * gy
                    yy += w * gy * gy
                    bx -= w * gx * value
                    by -= w * gy * value
                    ew += w
                    ex += w * gx
                    ey += w * gy
                    er += w * value
            z, e = zr / zw, er / ew
            xx -= zx * zx / zw + ex * ex / ew
            xy -= zx * zy / zw + ex * ey / ew
            yy -= zy * zy / zw + ey * ey / ew
            bx += zx * z + ex * e
            by += zy * z + ey * e
            det = xx * yy - xy * xy
            dx, dy = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
            x += dx
            y += dy
        return Estimate(
            x,
            y,
            yy / det,
            -xy / det,
            xx / det,
            z + (zx * dx + zy * dy) / zw,
            zx / zw,
            zy / zw,
            1.0 / zw,
            e + (ex * dx + ey * dy) / ew,
            ex / ew,
            ey / ew,
            1.0 / ew,
        )
