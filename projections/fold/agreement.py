"""Agreement of a sight and an estimate: the log-likelihood ratio of their being of one thing.

The numerator is the density of the camera's measurement if the thing is at the estimate, with the
errors of both; the denominator the density for another thing somewhere in view. Four parts:

bearing     variance: the estimate's across the ray, bearing and pose error; another thing: anywhere
            in the picture
range       the thing is at a distance from which things are usually seen
box height  the size it has at that distance is that of the thing, which may be unsure together with
            the position: two boxes from one spot are compared without regard to the distance
elevation   likewise that of the box's centre above the camera; another thing: as different as
            boxes in one picture are (`Slopes`)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import State
from .exact import log, log_of, logs
from .sights import Sight
from .spots import LEAST_ELEVATION_M2, LEAST_M, SLOPE, Estimate

Floats = NDArray[np.float64]
_WORST_CHI2 = 16.0
_ANYWHERE = -1.5
"""log(0.56 rad / √2π), the density of another thing's bearing: things are not spread evenly over a
picture."""
_SIZE = 0.15
"""Standard deviation of log size; above that of the estimate, which is of a mean."""
_OTHER_SIZES = 0.36
_WORST_PART = -12.0
"""The least that box height or elevation can add to a ratio, times two."""
_SIZE_KNOWN = 0.3
_BEHIND_M2 = 0.04
_SLOPE_GUESS, _GUESS_PAIRS = 0.01, 10.0
LEAST_AGREEMENT = -5.0
"""A pair with a lower ratio is ruled out."""
_FEW = 16
_SEEN = 13
_SLACK, _SLACK_CHI2, _SLACK_M2 = 1.001, 0.01, 1e-4


class Slopes:
    """The mean squared difference of the slopes of two boxes in one picture."""

    def __init__(self) -> None:
        self._sum, self._count = _SLOPE_GUESS * _GUESS_PAIRS, _GUESS_PAIRS

    @property
    def mean_square(self) -> float:
        """The mean square; starts from a guess that weighs as much as ten pairs."""
        return self._sum / self._count

    def learn(self, sights: Sequence[Sight]) -> None:
        """Count the pairs of boxes of a picture."""
        slopes = [sight.slope for sight in sights if sight.log_height is not None]
        for index, one in enumerate(slopes):
            for other in slopes[:index]:
                self._sum += (one - other) * (one - other)
                self._count += 1.0

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {"sums": [self._sum, self._count]}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._sum, self._count = state["sums"]


class Pairs(NamedTuple):
    """Pairs of an estimate and a sight that may be of one thing: row, column and ratio of each."""

    rows: NDArray[np.intp]
    columns: list[int]
    ratios: list[float]


_NO_PAIRS = Pairs(np.zeros(0, np.intp), [], [])


class Agreement:
    """Ratios for many estimates and the sights of a picture. An estimate farther than ``reach_m``
    from the camera is ruled out."""

    def __init__(self, range_m: float, range_spread: float, reach_m: float) -> None:
        self._log_range = log(range_m)
        self._range_variance = range_spread * range_spread
        self._reach_m2 = reach_m * reach_m
        self._farthest_m = reach_m * _SLACK

    def pairs(self, estimates: Floats, sights: Sequence[Sight], slopes: float) -> Pairs:
        """The pairs whose ratio is above `LEAST_AGREEMENT`; `is_ruled_out` may still rule some of
        them out. ``estimates`` has a row for each one; the sights are of one picture."""
        # Upper bound of twice a pair's ratio, without χ² of the bearing and the logarithm of its
        # variance.
        most = 2.0 * (_ANYWHERE - LEAST_AGREEMENT)
        most_whole = most + log_of(1.0 + _OTHER_SIZES / (_SIZE * _SIZE))
        most_whole += log_of(1.0 + slopes / LEAST_ELEVATION_M2)
        of_sights = [self._row_of(sight, most, most_whole) for sight in sights]
        seen = np.array(of_sights)
        rows, columns = self._sieve(estimates, seen)
        if not len(rows):
            return _NO_PAIRS
        if len(rows) <= _FEW:
            of_rows = estimates.take(rows, axis=0).tolist()
            places, numbers = columns.tolist(), range(len(rows))
            found = [self.ratio(of_rows[n], of_sights[places[n]], slopes) for n in numbers]
            few = [n for n in numbers if found[n] > LEAST_AGREEMENT]
            return Pairs(rows.take(few), [places[n] for n in few], [found[n] for n in few])
        ratios = self.ratios(
            estimates.take(rows, axis=0).T.copy(), seen.take(columns, axis=0).T.copy(), slopes
        )
        kept = (ratios > LEAST_AGREEMENT).nonzero()[0]
        return Pairs(rows.take(kept), columns.take(kept).tolist(), ratios.take(kept).tolist())

    def is_ruled_out(self, estimate: Estimate, sight: Sight) -> bool:
        """Whether the estimate is out of reach, or the bearing alone rules the pair out even if the
        estimate's variance across the ray were its total variance."""
        dx, dy = estimate[0] - sight[0], estimate[1] - sight[1]
        if dx * dx + dy * dy > self._reach_m2:
            return True
        cos, sin = sight[2], sight[3]
        ahead, across = dx * cos + dy * sin, dy * cos - dx * sin
        trace = estimate[2] + estimate[4]
        bound = ahead * ahead * sight[4] + (trace + sight[5])
        if across * across >= _WORST_CHI2 * bound:
            return True
        return ahead < 0.0 and ahead * ahead >= _WORST_CHI2 * (trace + _BEHIND_M2)

    def _row_of(self, sight: Sight, most: float, most_whole: float) -> tuple[float, ...]:
        """A sight as a row: `_SEEN` numbers for `ratios`, then those for `_sieve`."""
        x, y, cos, sin, per_m2, least, height, slope, *_ = sight
        if height is None:
            height, slope, whole = 0.0, 0.0, 0.0
        else:
            whole, most = 1.0, most_whole
        cc, ss, twice_cs = cos * cos, sin * sin, 2.0 * cos * sin
        chi2 = (most - log_of(per_m2 + least / self._reach_m2)) * _SLACK + _SLACK_CHI2
        return (
            *(x, y, cos, sin, cc, twice_cs, ss, cc, per_m2, least, height, slope, whole),
            *(cos, sin, 0.0, 0.0, 0.0),
            *(-sin, cos, 0.0, 0.0, 0.0),
            *(0.0, 0.0, chi2 * ss, chi2 * -twice_cs, chi2 * cc),
            chi2 * (least + LEAST_M * LEAST_M * per_m2) + _SLACK_M2,
            chi2 * per_m2,
        )

    def _sieve(self, estimates: Floats, seen: Floats) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """A quick filter: all pairs within reach whose ratio is above `LEAST_AGREEMENT`, and some
        more.

        A product of matrices gives, for each pair, the distance ahead, that across, and the most χ²
        that a pair can have times the estimate's variance across. The slack is far above its
        rounding errors, which differ from machine to machine.
        """
        count = len(seen)
        factors = seen[:, _SEEN:-2].reshape(count, 3, 5).transpose(1, 0, 2).reshape(-1, 5)
        more, per_m2 = seen[:, -2:].T[:, :, np.newaxis]
        here = np.array((seen[0, 0], seen[0, 1], 0.0, 0.0, 0.0))
        ahead, across, limit = factors.dot((estimates[:, :5] - here).T).reshape(3, count, -1)
        limit += more
        square = np.maximum(ahead, 0.0)
        square *= ahead
        square *= per_m2
        limit += square
        across *= across
        may_be: NDArray[np.bool_] = across < limit
        may_be &= ahead < self._farthest_m
        rows, columns = may_be.T.nonzero()
        return rows, columns

    def ratio(self, estimate: Sequence[float], seen: Sequence[float], slopes: float) -> float:
        """`ratios` of one pair, equal to the last bit; quicker for few pairs."""
        x, y, xx, xy, yy, size, size_x, size_y, size_variance, *elevation = estimate
        px, py, cos, sin, cc, twice_cs, ss, _, per_m2, least, height, slope, whole = seen[:_SEEN]
        dx, dy = x - px, y - py
        ahead, across = dx * cos + dy * sin, dy * cos - dx * sin
        along = max(LEAST_M, ahead)
        square = along * along
        cs = twice_cs * xy
        along_variance = xx * cc + cs + yy * ss
        variance = xx * ss - cs + yy * cc + per_m2 * square + least
        ratio = across * across / variance + log_of(variance / square)
        log_along = log_of(along)
        residual = log_along - self._log_range
        ratio += residual * residual / (self._range_variance + along_variance / square)
        if ahead < LEAST_M:
            behind = ahead - LEAST_M
            ratio += behind * behind / (along_variance + _BEHIND_M2)
        if not (whole and size_variance < _SIZE_KNOWN):
            return -ratio * 0.5 + _ANYWHERE
        gx, gy = 1.0 / along * cos - size_x, 1.0 / along * sin - size_y
        spread = gx * (gx * xx + 2.0 * xy * gy) + gy * gy * yy + size_variance + _SIZE * _SIZE
        other = spread + _OTHER_SIZES
        rest = height + log_along - size
        part = rest * rest * (1.0 / other - 1.0 / spread) + log_of(other / spread)
        speaks = max(_WORST_PART, part)
        height, height_x, height_y, height_variance = elevation
        gx, gy = slope * cos - height_x, slope * sin - height_y
        spread = gx * (gx * xx + 2.0 * xy * gy) + gy * gy * yy + height_variance
        spread += (SLOPE * SLOPE) * square + LEAST_ELEVATION_M2
        other = spread + slopes * square
        rest = along * slope - height
        part = rest * rest * (1.0 / other - 1.0 / spread) + log_of(other / spread)
        speaks += max(_WORST_PART, part)
        return (speaks - ratio) * 0.5 + _ANYWHERE

    def ratios(self, estimates: Floats, seen: Floats, slopes: float) -> Floats:
        """The ratio of each pair: columns of the two matrices."""
        xx, yy = estimates[2], estimates[4]
        heights = estimates[5:].reshape(2, 4, -1)  # of log size and elevation
        direction = seen[2:4]
        offset = estimates[:2] - seen[:2]
        both = offset * direction
        ahead = both[0] + both[1]
        both = offset[::-1] * direction
        across = both[0] - both[1]
        along = np.maximum(ahead, LEAST_M)
        square = along * along
        both = estimates[2:5] * seen[4:7]
        cs = both[1]
        along_variance = both[0] + cs
        along_variance += both[2]
        both = estimates[2:5:2] * seen[6:8]
        variance = both[0] - cs
        variance += both[1]
        variance += seen[8] * square
        variance += seen[9]
        slope = seen[11]
        steep = np.empty((2, len(along)))
        np.divide(1.0, along, out=steep[0])
        steep[1] = slope
        gx, gy = steep * direction[0], steep * direction[1]
        gx -= heights[:, 1]
        gy -= heights[:, 2]
        spread = (2.0 * estimates[3]) * gy
        spread += gx * xx
        spread *= gx
        gy *= gy
        gy *= yy
        spread += gy
        spread += heights[:, 3]
        spread[0] += _SIZE * _SIZE
        spread[1] += (SLOPE * SLOPE) * square + LEAST_ELEVATION_M2
        other = spread.copy()
        other[0] += _OTHER_SIZES
        other[1] += slopes * square
        wanted = np.empty((4, len(along)))
        wanted[0] = along
        np.divide(variance, square, out=wanted[1])
        np.divide(other, spread, out=wanted[2:])
        logarithms = logs(wanted)
        log_along = logarithms[0]
        ratio = across * across
        ratio /= variance
        ratio += logarithms[1]
        residual = log_along - self._log_range
        residual *= residual
        residual /= along_variance / square + self._range_variance
        ratio += residual
        behind = np.minimum(ahead - LEAST_M, 0.0)
        behind *= behind
        behind /= along_variance + _BEHIND_M2
        ratio += behind
        rest = np.empty((2, len(along)))
        np.add(seen[10], log_along, out=rest[0])
        np.multiply(along, slope, out=rest[1])
        rest -= heights[:, 0]
        rest *= rest
        np.divide(1.0, other, out=other)
        np.divide(1.0, spread, out=spread)
        other -= spread
        rest *= other
        rest += logarithms[2:]
        part = np.maximum(rest, _WORST_PART)
        whole: Floats = part[0] + part[1]
        whole *= seen[12] * (heights[0, 3] < _SIZE_KNOWN)
        whole -= ratio
        whole *= 0.5
        whole += _ANYWHERE
        return whole
