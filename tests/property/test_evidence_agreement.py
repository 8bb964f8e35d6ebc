"""Agreement of estimates and sights: the sieve drops no pair that counts, one pair alone gives the
bits that it gives among many, and a ratio is that of the densities that the module states."""

import math

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st

from projections.fold import agreement
from projections.fold.agreement import LEAST_AGREEMENT, Agreement, Pairs
from projections.fold.sights import Sight
from projections.fold.spots import COMMON_M2, LEAST_ELEVATION_M2, LEAST_M, SLOPE, Estimate

RANGE_M, RANGE_SPREAD, REACH_M = 3.0, 0.55, 8.3
AGREEMENT = Agreement(RANGE_M, RANGE_SPREAD, REACH_M)
_WIDE = st.floats(0.0, 1.0).map(lambda share: 10.0 ** (share * 9.0 - 3.0))  # 0.001 to 10⁶ m²
_ORIGINS = st.sampled_from([(0.0, 0.0), (-3.0, 1e3), (9.99e6, -9.99e6)])


@st.composite
def estimates(draw: st.DrawFn, origin: tuple[float, float]) -> Estimate:
    """An estimate near a point, of any shape and as unsure as there are."""
    far, angle, turn = draw(st.floats(0.0, 12.0)), draw(st.floats(0.0, 6.3)), draw(st.floats(0, 3))
    x, y = origin[0] + far * math.cos(angle), origin[1] + far * math.sin(angle)
    wide, narrow = draw(_WIDE), draw(_WIDE)
    cos, sin = math.cos(turn), math.sin(turn)
    xx = wide * cos * cos + narrow * sin * sin + COMMON_M2
    yy = wide * sin * sin + narrow * cos * cos + COMMON_M2
    xy = (wide - narrow) * cos * sin
    size = draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3, st.floats(1e-3, 0.5)))
    elevation = draw(st.tuples(*[st.floats(-1.0, 1.0)] * 3, st.floats(1e-3, 0.5)))
    return Estimate(x, y, xx, xy, yy, *size, *elevation)


@st.composite
def sights(draw: st.DrawFn, origin: tuple[float, float]) -> Sight:
    """A sight from a point: of a box, cut or not, or of a measured position."""
    angle = draw(st.floats(0.0, 6.3))
    to = math.cos(angle), math.sin(angle)
    if draw(st.integers(0, 4)) == 0:
        variance = draw(st.floats(0.001, 1.0)) ** 2
        return Sight(*origin, *to, 0.0, variance, None, 0.0, *to, (3.0, variance))
    per_m2, least = draw(st.floats(0.001, 3.2)) ** 2, draw(st.floats(0.001, 1.0)) ** 2
    height = draw(st.none() | st.floats(-5.0, 3.0))
    slope = 0.0 if height is None else draw(st.floats(-2.0, 2.0))
    return Sight(*origin, *to, per_m2, least, height, slope, *to, None)


@st.composite
def pictures(draw: st.DrawFn) -> tuple[list[Estimate], list[Sight]]:
    """Things around one point, and what a picture taken there says."""
    origin = draw(_ORIGINS)
    return (
        draw(st.lists(estimates(origin), min_size=1, max_size=9)),
        draw(st.lists(sights(origin), min_size=1, max_size=5)),
    )


def _all_pairs(
    found: list[Estimate], seen: list[Sight], slopes: float
) -> dict[tuple[int, int], float]:
    """Every pair compared on its own, none sieved."""
    rows = [AGREEMENT._row_of(sight, 1.0, 1.0) for sight in seen]
    return {
        (row, column): AGREEMENT.ratio(estimate, rows[column], slopes)
        for row, estimate in enumerate(found)
        for column in range(len(seen))
    }


def _left(pairs: Pairs, found: list[Estimate], seen: list[Sight]) -> dict[tuple[int, int], float]:
    return {
        (row, column): ratio
        for row, column, ratio in zip(pairs.rows.tolist(), pairs.columns, pairs.ratios, strict=True)
        if not AGREEMENT.is_ruled_out(found[row], seen[column])
    }


@given(pictures(), st.floats(1e-4, 4.0), st.sampled_from([0, 1000]))
def test_the_sieve_drops_no_pair_that_counts(
    picture: tuple[list[Estimate], list[Sight]], slopes: float, few: int
) -> None:
    found, seen = picture
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(agreement, "_FEW", few)
        pairs = AGREEMENT.pairs(np.array(found), seen, slopes)
    wanted = {
        (row, column): ratio
        for (row, column), ratio in _all_pairs(found, seen, slopes).items()
        if ratio > LEAST_AGREEMENT and not AGREEMENT.is_ruled_out(found[row], seen[column])
    }
    event(f"some left: {bool(wanted)}")
    left = _left(pairs, found, seen)
    assert left == wanted  # to the last bit, by arrays and one by one
    assert list(left) == sorted(left)


@given(pictures(), st.floats(1e-4, 4.0))
def test_one_pair_is_compared_as_among_many(
    picture: tuple[list[Estimate], list[Sight]], slopes: float
) -> None:
    found, seen = picture
    rows, columns = np.indices((len(found), len(seen))).reshape(2, -1)
    of_sights = np.array([AGREEMENT._row_of(sight, 1.0, 1.0) for sight in seen])
    many = AGREEMENT.ratios(
        np.array(found).take(rows, axis=0).T.copy(),
        of_sights.take(columns, axis=0).T.copy(),
        slopes,
    )
    assert many.tolist() == list(_all_pairs(found, seen, slopes).values())


def _densities(estimate: Estimate, sight: Sight, slopes: float) -> float:
    """The ratio by matrices and the logarithms of the platform."""
    covariance = np.array([(estimate.xx, estimate.xy), (estimate.xy, estimate.yy)])
    offset = np.array([estimate.x - sight.x, estimate.y - sight.y])
    ray, side = np.array([sight.cos, sight.sin]), np.array([-sight.sin, sight.cos])
    ahead, across = float(offset @ ray), float(offset @ side)
    along = max(ahead, LEAST_M)
    depth = float(ray @ covariance @ ray)
    variance = float(side @ covariance @ side) + sight.across_per_m2 * along**2 + sight.across_m2
    against = across**2 / variance + math.log(variance / along**2)
    against += math.log(along / RANGE_M) ** 2 / (RANGE_SPREAD**2 + depth / along**2)
    against += min(ahead - LEAST_M, 0.0) ** 2 / (depth + 0.04)
    speaks = 0.0
    if sight.log_height is not None and estimate.log_size_variance < 0.3:
        size, elevation = estimate[5:9], estimate[9:13]
        for at, gradient, known, noise, others in (
            (sight.log_height + math.log(along), ray / along, size, 0.15**2, 0.36),
            (
                along * sight.slope,
                ray * sight.slope,
                elevation,
                (SLOPE * along) ** 2 + LEAST_ELEVATION_M2,
                slopes * along**2,
            ),
        ):
            slant = gradient - np.array(known[1:3])
            spread = float(slant @ covariance @ slant) + known[3] + noise
            other = spread + others
            rest = at - known[0]
            speaks += max(rest**2 / other - rest**2 / spread + math.log(other / spread), -12.0)
    return (speaks - against) / 2 - 1.5


@given(estimates((0.0, 0.0)), sights((0.0, 0.0)), st.floats(1e-4, 4.0))
def test_a_ratio_is_that_of_the_densities(estimate: Estimate, sight: Sight, slopes: float) -> None:
    seen = AGREEMENT._row_of(sight, 1.0, 1.0)
    wanted = _densities(estimate, sight, slopes)
    assert AGREEMENT.ratio(estimate, seen, slopes) == pytest.approx(wanted, rel=1e-4, abs=1e-3)
