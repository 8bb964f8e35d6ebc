"""The fit of re-localisation's weights: what it finds, and that every map counts the same."""

import math

import numpy as np
import pytest

from scripts.programs.fit_confidence import Row, fit, fit_both


def test_planted_weights_are_found() -> None:
    rng = np.random.default_rng(3)
    x = rng.normal(size=(6000, 2)) * [1.0, 20.0]
    z = 0.5 + x @ [2.0, -0.1]
    y = rng.random(len(x)) < 1.0 / (1.0 + np.exp(-z))
    found = fit(x, y, np.ones(len(x)))
    assert found == pytest.approx((0.5, 2.0, -0.1), rel=0.15)


def test_what_is_always_right_has_finite_weights() -> None:
    x = np.linspace(-1.0, 1.0, 50)[:, None]
    found = fit(x, x[:, 0] > 0.0, np.ones(50))
    assert all(math.isfinite(each) for each in found)
    assert found[1] > 5.0


def test_a_map_counts_as_much_as_one_that_was_asked_more() -> None:
    """Of one map half is known, of the other all; the second was asked a hundred times more."""

    def row(world: str, known: bool) -> Row:
        return Row(("rover", world), "1 crop", (0.0,), (0.0,), known, not known)

    rows = [row("small", n % 2 == 0) for n in range(20)] + [row("large", True)] * 2000
    weights = fit_both(rows)
    assert 1.0 / (1.0 + math.exp(-weights.known[0])) == pytest.approx(0.75, abs=0.01)
    assert 1.0 / (1.0 + math.exp(-weights.confidence[0])) == pytest.approx(0.25, abs=0.01)
