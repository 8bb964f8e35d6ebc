"""How much a sight and an estimate speak for one thing: the logarithm of a likelihood ratio.

The numerator is the density of what the camera measured if the thing stands where the estimate
says, with the errors of both; the denominator that for another thing somewhere in view. Four parts:

bearing     variance: the estimate's across the ray, bearing and pose error; another thing: anywhere
            in the picture
range       the thing is at a distance from which things are usually seen
box height  the size it has at that distance is that of the thing, which may be unsure together with
            the position: two boxes from one spot are compared without regard to the distance
elevation   likewise that of the box's centre above the camera; another thing: as different as
            boxes in one picture are (`Slopes`)
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.exact_functions import log
from projections.reducers import State

from .sights import Sight
from .spots import LEAST_ELEVATION_M2, LEAST_M, SLOPE, Estimate

Floats = NDArray[np.float64]
ESTIMATE_FIELDS = len(Estimate._fields)
_WORST_CHI2 = 16.0
_ANYWHERE = -1.5
"""log(0.56 rad / √2π): in front of one another for a picture, things are not spread evenly."""
_SIZE = 0.15
"""A little more than in the estimate, where the error of a mean counts."""
_OTHER_SIZES = 0.36
_WORST_PART = -12.0
"""Twice what box height, or elevation, can say against a thing at most."""
_SIZE_KNOWN = 0.3
_BEHIND_M2 = 0.04
_SLOPE_GUESS, _GUESS_PAIRS = 0.01, 10.0


class Slopes:
    """How much the slopes of two boxes in one picture differ: the mean square."""

    def __init__(self) -> None:
        self._sum, self._count = _SLOPE_GUESS * _GUESS_PAIRS, _GUESS_PAIRS

    @property
    def mean_square(self) -> float:
        """A guess that ten pairs outweigh, at first."""
        return self._sum / self._count

    def learn(self, sights: Sequence[Sight]) -> None:
        """Take in a picture."""
        slopes = [sight.slope for sight in sights if sight.log_height is not None]
        for index, one in enumerate(slopes):
            for other in slopes[:index]:
                self._sum += (one - other) * (one - other)
                self._count += 1.0

    def dump(self) -> State:
        """Everything, for a snapshot."""
        return {"sums": [self._sum, self._count]}

    def load(self, state: State) -> None:
        """Take over what `dump` gave."""
        self._sum, self._count = state["sums"]


class Pairs(NamedTuple):
    """Pairs of an estimate and a sight that may be of one thing: row, column and ratio of each."""

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    ratios: Floats


class Agreement:
    """Ratios for many estimates and the sights of a picture."""

    def __init__(self, range_m: float, range_spread: float) -> None:
        self._log_range = log(range_m)
        self._range_variance = range_spread * range_spread

    def pairs(
        self, estimates: Floats, sights: Sequence[Sight], slopes: float, least: float
    ) -> Pairs:
        """The pairs whose ratio is above ``least``. ``estimates`` has a column for each one."""
        seen = np.array([_column_of(sight) for sight in sights]).T
        # What the bearing rules out at its best is left out first, since that is nearly all.
        dx = estimates[0, :, np.newaxis] - seen[0]
        dy = estimates[1, :, np.newaxis] - seen[1]
        ahead = dx * seen[2] + dy * seen[3]
        across = dy * seen[2] - dx * seen[3]
        trace = (estimates[2] + estimates[4])[:, np.newaxis]
        bound = ahead * ahead * seen[4] + (trace + seen[5])
        may_be = (across * across < _WORST_CHI2 * bound) & (
            np.minimum(ahead, 0.0) * ahead < _WORST_CHI2 * (trace + _BEHIND_M2)
        )
        rows, columns = may_be.nonzero()
        if not len(rows):
            return Pairs(rows, columns, np.zeros(0))
        ratios = self._ratios(
            estimates.take(rows, axis=1),
            seen.take(columns, axis=1),
            ahead[may_be],
            across[may_be],
            slopes,
        )
        kept = (ratios > least).nonzero()[0]
        return Pairs(rows[kept], columns[kept], ratios[kept])

    def _ratios(
        self, estimates: Floats, seen: Floats, ahead: Floats, across: Floats, slopes: float
    ) -> Floats:
        """The ratio of each pair: columns of the two matrices."""
        _, _, xx, xy, yy = estimates[:5]
        heights = estimates[5:].reshape(2, 4, -1)  # of log size and elevation
        _, _, cos, sin, per_m2, least, height, slope, is_whole, cc, ss, twice_cs = seen
        along = np.maximum(ahead, LEAST_M)
        square = along * along
        cs = twice_cs * xy
        along_variance = xx * cc + cs + yy * ss
        variance = xx * ss - cs + yy * cc + per_m2 * square + least
        steep = np.array((1.0 / along, slope))
        gx, gy = steep * cos - heights[:, 1], steep * sin - heights[:, 2]
        spread = gx * (gx * xx + 2.0 * xy * gy) + gy * gy * yy + heights[:, 3]
        spread[0] += _SIZE * _SIZE
        spread[1] += (SLOPE * SLOPE) * square + LEAST_ELEVATION_M2
        other = np.array((spread[0] + _OTHER_SIZES, spread[1] + slopes * square))
        wanted = np.empty((4, len(along)))
        wanted[0] = along
        np.divide(variance, square, out=wanted[1])
        np.divide(other, spread, out=wanted[2:])
        logarithms = logs(wanted)
        log_along = logarithms[0]
        ratio = across * across / variance + logarithms[1]
        residual = log_along - self._log_range
        ratio += residual * residual / (self._range_variance + along_variance / square)
        behind = np.minimum(ahead - LEAST_M, 0.0)
        ratio += behind * behind / (along_variance + _BEHIND_M2)
        rest = np.array((height + log_along, along * slope)) - heights[:, 0]
        part = np.maximum(rest * rest * (1.0 / other - 1.0 / spread) + logarithms[2:], _WORST_PART)
        whole: Floats = (part[0] + part[1]) * (is_whole * (heights[0, 3] < _SIZE_KNOWN))
        whole -= ratio
        whole *= 0.5
        whole += _ANYWHERE
        return whole


def _column_of(sight: Sight) -> tuple[float, ...]:
    """What `Agreement` compares of a sight, and products of its direction's parts."""
    _, _, cos, sin, *_ = sight
    whole = (0.0, 0.0, 0.0) if sight.log_height is None else (sight.log_height, sight.slope, 1.0)
    return *sight[:6], *whole, cos * cos, sin * sin, 2.0 * cos * sin


def log_of(value: float) -> float:
    """`logs` of one number, to the last bit."""
    mantissa, twos = math.frexp(value)
    s = (mantissa - 0.7071067811865476) / (mantissa + 0.7071067811865476)
    square = s * s
    series = (square * 0.4 + 2.0 / 3.0) * square + 2.0
    return (twos - 0.5) * 0.6931471805599453 + s * series


def logs(values: Floats) -> Floats:
    """Natural logarithms of positive numbers, right to some 10⁻⁵, the same bits everywhere."""
    mantissas, twos = np.frexp(values)
    s = (mantissas - 0.7071067811865476) / (mantissas + 0.7071067811865476)
    square = s * s
    series = (square * 0.4 + 2.0 / 3.0) * square + 2.0
    result: Floats = (twos - 0.5) * 0.6931471805599453 + s * series
    return result
