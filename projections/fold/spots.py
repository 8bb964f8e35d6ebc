"""Estimate a thing's position and its covariance from sights.

Sights from one spot (closer than `SPOT_M`) share their errors: twelve views from one pose are no
triangulation. So a spot keeps the mean of its sights, and they weigh min(n, 1.5) together; a sight
that may be of another thing counts as its probability. The range prior is shared by all spots, too,
and weighs as much as 1.5 spots.

The unknowns are the position p, the logarithm z of the thing's height, and its elevation e above
the camera. At the distance a from a spot,

    bearing     0 = across / a                   variance (bearing error)² + (pose error / a)²
    range       log a = log(usual range)         (range_spread)²
    box height  log a + log(height / f) = z      SIZE², where the border does not cut it
    its centre  a · slope = e                    (SLOPE · a)² + (2 cm)²; a level camera
    measured    a = depth                        that of the depth or position

z and e have their class's priors (`thing_index`). On a drive towards a thing, its growing box
determines the distance, as a change of bearing does. Gauss-Newton in information form; z and e are
eliminated (Schur's complement). A residual beyond about two standard errors weighs less (Cauchy).

Each spot's part of the normal equations is kept, linearised where the estimate was; a sight changes
the part of its spot alone. All are computed again once the estimate has moved by more than
`_MOVED_M` since. +, −, ×, ÷, √ in one fixed order: the same bits on every machine.

Errors common to all poses (a session's drift, a box whose centre is not the thing's) do not average
out: `COMMON_M2` is added to the variance of the estimate.
"""

import math
from typing import NamedTuple

from .exact import log
from .sights import Sight

SPOT_M = 0.35
MAX_SPOTS = 12
LEAST_M = 0.3
SIZE = 0.12
SLOPE = 0.02
LEAST_ELEVATION_M2 = 0.0004
VIEWS_OF_A_SPOT = 1.5
"""The number of independent views that all views of one spot count as."""
_TAIL = 4.0
_MORE_ROUNDS = 1
_MOVED_M = 0.2
_LEAST_DET, _FARTHEST_M, _MOST_VARIANCE_M2 = 1e-13, 1e5, 1e7
"""Solutions beyond these bounds are refused; no plausible picture of a level camera comes near
them."""
COMMON_M2 = 0.02
"""(0.14 m)²."""
_WEIGHT, _COUNT, _HEIGHT, _HEIGHTS, _SLOPED, _DEPTH, _DEPTH_WEIGHT = range(6, 13)

Spot = list[float]
"""Means of x, y, cos, sin, across_per_m2, across_m2 of its sights, weighed by the precision of the
bearing; that weight; number of sights; mean log height, their number, mean slope; mean measured
distance, its precision."""
Part = list[float]
"""A spot's part of the normal equations in (x, y): matrix xx, xy, yy and right side of what is
measured; the same of the range prior at weight 1; weight, gradient x, y and sum of the log size;
of the elevation."""
PART_SIZE = 18


class HeightPrior(NamedTuple):
    """Mean and precision (1 / variance) of a class's log size, and of its elevation in metres."""

    log_size: float
    log_size_weight: float
    elevation: float
    elevation_weight: float


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
    """The spots that a thing was seen from, their parts, the sum of these, where they were
    linearised, and the number of spots ever."""

    __slots__ = ("at", "parts", "seen_from", "spots", "total")

    def __init__(self) -> None:
        self.spots: list[Spot] = []
        self.parts: list[Part] = []
        self.total: Part = [0.0] * PART_SIZE
        self.at = (0.0, 0.0)
        self.seen_from = 0

    def add(self, sight: Sight, share: float) -> int:
        """Add a sight and return the index of its spot, whose part is then out of date."""
        x, y, cos, sin, per_m2, least, height, slope, _, _, measured = sight
        weight, heights, depth, depth_weight = share / (per_m2 + least), share, 0.0, 0.0
        if height is None:
            height, heights = 0.0, 0.0
        if measured is not None:
            depth, depth_weight = measured[0], share / measured[1]
        numbers = (x, y, cos, sin, per_m2, least, weight, share, height, heights, slope)
        return self._add_spot([*numbers, depth, depth_weight])

    def add_all(self, other: "Spots") -> None:
        """Add the spots of an absorbed thing. All parts are then out of date."""
        for spot in other.spots:
            self._add_spot(spot)

    def _add_spot(self, new: Spot) -> int:
        found, best = -1, SPOT_M * SPOT_M
        x, y, cos, sin, per_m2, least, weight, count, height, heights, slope, *depth = new
        for index, spot in enumerate(self.spots):
            dx = spot[0] - x
            if -SPOT_M < dx < SPOT_M:
                dy = spot[1] - y
                far = dx * dx + dy * dy
                if far < best:
                    found, best = index, far
        if found < 0:
            self.seen_from += 1
            self.spots.append(new)
            self.parts.append([0.0] * PART_SIZE)
            if len(self.spots) > MAX_SPOTS:
                self._drop(1)  # the first one holds the view that founded the thing
            return len(self.spots) - 1
        nearest = self.spots[found]
        nx, ny, mean_cos, mean_sin, n_per_m2, n_least, total, *_ = nearest
        total += weight
        share = weight / total
        mean_cos += (cos - mean_cos) * share
        mean_sin += (sin - mean_sin) * share
        length = math.sqrt(mean_cos * mean_cos + mean_sin * mean_sin)
        if length > 0.0:
            mean_cos /= length
            mean_sin /= length
        nearest[: _WEIGHT + 1] = (
            nx + (x - nx) * share,
            ny + (y - ny) * share,
            mean_cos,
            mean_sin,
            n_per_m2 + (per_m2 - n_per_m2) * share,
            n_least + (least - n_least) * share,
            total,
        )
        nearest[_COUNT] += count
        if heights > 0.0:
            nearest[_HEIGHTS] += heights
            share = heights / nearest[_HEIGHTS]
            nearest[_HEIGHT] += (height - nearest[_HEIGHT]) * share
            nearest[_SLOPED] += (slope - nearest[_SLOPED]) * share
        depth_m, depth_weight = depth
        if depth_weight > 0.0:
            nearest[_DEPTH_WEIGHT] += depth_weight
            share = depth_weight / nearest[_DEPTH_WEIGHT]
            nearest[_DEPTH] += (depth_m - nearest[_DEPTH]) * share
        return found

    def _drop(self, index: int) -> None:
        self.total = [a - b for a, b in zip(self.total, self.parts[index], strict=True)]
        del self.spots[index], self.parts[index]


class Solver:
    """Solves for the estimate; ``range_m`` and ``range_spread`` as in the constants."""

    def __init__(self, range_m: float, range_spread: float) -> None:
        self._range_m = range_m
        self._log_range = log(range_m)
        self._range_weight = 1.0 / (range_spread * range_spread)

    def first(self, spots: Spots, prior: HeightPrior) -> Estimate:
        """The estimate of a new thing."""
        spot = spots.spots[0]
        start = spot[_DEPTH] if spot[_DEPTH_WEIGHT] > 0.0 else self._range_m
        x, y = spot[0] + start * spot[2], spot[1] + start * spot[3]
        self._linearise(spots, x, y, None)
        estimate = self._solve(spots, prior) or _anywhere(x, y, prior)
        for _ in range(_MORE_ROUNDS):
            self._linearise(spots, estimate.x, estimate.y, estimate)
            estimate = self._solve(spots, prior) or estimate
        return estimate

    def next(
        self, spots: Spots, prior: HeightPrior, before: Estimate, index: int | None
    ) -> Estimate:
        """The estimate after the spot of that index has changed, or all of them (None)."""
        if index is None:
            self._linearise(spots, before.x, before.y, before)
        else:
            part = self._part(spots.spots[index], before.x, before.y, before)
            old, total = spots.parts[index], spots.total
            spots.total = [a + (b - c) for a, b, c in zip(total, part, old, strict=True)]
            spots.parts[index] = part
        estimate = self._solve(spots, prior)
        if estimate is None:
            self._linearise(spots, before.x, before.y, before)
            estimate = self._solve(spots, prior) or before
        dx, dy = estimate.x - spots.at[0], estimate.y - spots.at[1]
        if dx * dx + dy * dy > _MOVED_M * _MOVED_M:
            self._linearise(spots, estimate.x, estimate.y, estimate)
            estimate = self._solve(spots, prior) or estimate
        return estimate

    def _linearise(self, spots: Spots, x: float, y: float, about: Estimate | None) -> None:
        """Compute all parts again."""
        spots.at = x, y
        spots.parts = [self._part(spot, x, y, about) for spot in spots.spots]
        total = [0.0] * PART_SIZE
        for part in spots.parts:
            total = [a + b for a, b in zip(total, part, strict=True)]
        spots.total = total

    def _part(self, spot: Spot, x: float, y: float, about: Estimate | None) -> Part:
        """The part of a spot, linearised at (x, y); outliers by the sizes of ``about``."""
        px, py, cos, sin, per_m2, least, _, count, height, heights, slope, depth, weight = spot
        dx, dy = x - px, y - py
        along, across = dx * cos + dy * sin, dy * cos - dx * sin
        if along < LEAST_M:
            along = LEAST_M
        variance = per_m2 * along * along + least
        w = (min(VIEWS_OF_A_SPOT, count)) / variance
        w /= 1.0 + across * across / (variance * _TAIL)
        ws, wc = w * sin, w * cos
        # the bearing's line: n·p = n·s with n = (−sin, cos)
        offset = cos * py - sin * px
        xx, xy, yy, bx, by = ws * sin, -ws * cos, wc * cos, -ws * offset, wc * offset
        if weight > 0.0:
            wc, ws = weight * cos, weight * sin
            distance = cos * px + sin * py + depth
            xx += wc * cos
            xy += wc * sin
            yy += ws * sin
            bx += wc * distance
            by += ws * distance
        log_along = log(along)
        gx, gy = cos / along, sin / along
        here = gx * x + gy * y
        aim = self._log_range - log_along + here
        usual = gx * gx, gx * gy, gy * gy, gx * aim, gy * aim
        if heights == 0.0:
            return [xx, xy, yy, bx, by, *usual, *_NO_HEIGHT]
        share = min(VIEWS_OF_A_SPOT, heights)
        value = height + log_along
        w = share / (SIZE * SIZE)
        if about is not None:
            rest = value - about.log_size
            w /= 1.0 + rest * rest * w / _TAIL
        # log size = value + g·(p − here)
        constant = value - here
        wx, wy = w * gx, w * gy
        xx += wx * gx
        xy += wx * gy
        yy += wy * gy
        bx -= wx * constant
        by -= wy * constant
        size = w, wx, wy, w * constant
        value = along * slope
        w = share / (SLOPE * SLOPE * along * along + LEAST_ELEVATION_M2)
        if about is not None:
            rest = value - about.elevation
            w /= 1.0 + rest * rest * w / _TAIL
        gx, gy = slope * cos, slope * sin
        constant = value - gx * x - gy * y
        wx, wy = w * gx, w * gy
        xx += wx * gx
        xy += wx * gy
        yy += wy * gy
        bx -= wx * constant
        by -= wy * constant
        return [xx, xy, yy, bx, by, *usual, *size, w, wx, wy, w * constant]

    def _solve(self, spots: Spots, prior: HeightPrior) -> Estimate | None:
        """Solve the normal equations of all parts; None where rounding errors decide the result,
        or it is far from where the parts were linearised."""
        xx, xy, yy, bx, by, rxx, rxy, ryy, rx, ry, zw, zx, zy, zr, ew, ex, ey, er = spots.total
        count = len(spots.spots)
        weight = self._range_weight
        if count > VIEWS_OF_A_SPOT:
            weight *= VIEWS_OF_A_SPOT / count
        z_mean, z_prior, e_mean, e_prior = prior
        zw += z_prior
        zr += z_prior * z_mean
        ew += e_prior
        er += e_prior * e_mean
        # z = (zr + (zx, zy)·p) / zw minimises the sum of squares for a given p, e likewise
        xx += weight * rxx - zx * zx / zw - ex * ex / ew
        xy += weight * rxy - zx * zy / zw - ex * ey / ew
        yy += weight * ryy - zy * zy / zw - ey * ey / ew
        bx += weight * rx + zx * zr / zw + ex * er / ew
        by += weight * ry + zy * zr / zw + ey * er / ew
        det = xx * yy - xy * xy
        if not (xx > 0.0 and yy > 0.0 and det > _LEAST_DET * (xx + yy) * (xx + yy)):
            return None
        x, y = (yy * bx - xy * by) / det, (xx * by - xy * bx) / det
        is_near = abs(x - spots.at[0]) <= _FARTHEST_M and abs(y - spots.at[1]) <= _FARTHEST_M
        if not (is_near and (xx + yy) / det <= _MOST_VARIANCE_M2):
            return None
        position = x, y, yy / det + COMMON_M2, -xy / det, xx / det + COMMON_M2
        size = (zr + zx * x + zy * y) / zw, zx / zw, zy / zw, 1.0 / zw
        elevation = (er + ex * x + ey * y) / ew, ex / ew, ey / ew, 1.0 / ew
        return Estimate._make(position + size + elevation)


def _anywhere(x: float, y: float, prior: HeightPrior) -> Estimate:
    """The estimate of a thing whose first sight has no information."""
    z_mean, z_prior, e_mean, e_prior = prior
    size, elevation = (z_mean, 0.0, 0.0, 1.0 / z_prior), (e_mean, 0.0, 0.0, 1.0 / e_prior)
    return Estimate(x, y, _MOST_VARIANCE_M2, 0.0, _MOST_VARIANCE_M2, *size, *elevation)


_NO_HEIGHT = (0.0,) * 8
