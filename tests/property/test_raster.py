"""A raster's distances against the distance of every point to every keyframe."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from projections.adapters.drawing.base_layers import FAR_M, REACH_M, Raster

BOUNDS = (-3.0, -2.0, 4.0, 3.0)
COORDINATE = st.floats(-6.0, 6.0)


@given(st.lists(st.tuples(COORDINATE, COORDINATE), max_size=12))
def test_within_the_regions_it_is_the_distance_to_the_nearest(
    spots: list[tuple[float, float]],
) -> None:
    raster = Raster(BOUNDS)
    whole = np.full((len(raster.ys), len(raster.xs)), FAR_M)
    patch = raster.distances(spots)
    whole[patch.rows, patch.columns] = patch.field
    plain = np.full(whole.shape, np.inf)
    for x, y in spots:
        plain = np.minimum(plain, np.hypot(raster.xs[None, :] - x, raster.ys[:, None] - y))
    shows = plain <= REACH_M + np.sqrt(2) * raster.step
    assert (whole[shows] == plain[shows]).all()
    assert (whole[~shows] > REACH_M).all()


@pytest.mark.parametrize("size_m", [5.0, 50.0, 500.0])
def test_the_cost_of_a_keyframe_does_not_grow_with_the_canvas(size_m: float) -> None:
    """With distances to all points a drive of 20,000 keyframes took a quarter of a minute."""
    raster = Raster((0.0, 0.0, size_m, size_m))
    rows, columns = raster.around(size_m / 2, size_m / 2)
    most = 2 * (REACH_M / raster.step + 2) + 1
    assert 0 < rows.stop - rows.start <= most
    assert 0 < columns.stop - columns.start <= most
