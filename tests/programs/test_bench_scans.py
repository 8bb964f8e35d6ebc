"""Scans, scores and table of ``scripts/bench_scans``."""

import numpy as np
import pytest

from eventsrc.envelope.model import NO_RETURN_MM
from scripts.programs.bench.scans import BEAMS, REACH_M, ScansRow, cast, scans_table


def test_a_lidar_measures_the_walls_ahead_of_it_and_nothing_beyond_its_reach() -> None:
    walls = np.array([[2.0, -5.0, 2.0, 5.0], [-20.0, -5.0, -20.0, 5.0], [3.0, -5.0, 3.0, 5.0]])
    ranges = cast(walls, (0.0, 0.0, 0.0), np.random.default_rng(0)).ranges()
    assert ranges[0] == pytest.approx(2000, abs=60)
    assert ranges[45] == pytest.approx(2000 * 2**0.5, abs=60)
    assert ranges[BEAMS // 2] == NO_RETURN_MM
    assert ranges[ranges != NO_RETURN_MM].max() < 1000 * REACH_M
    turned = cast(walls, (0.0, 0.0, np.pi / 2), np.random.default_rng(0)).ranges()
    assert turned[BEAMS * 3 // 4] == pytest.approx(2000, abs=60)


def test_the_table_ends_with_the_farthest_below_the_true_map_and_names_the_dearest() -> None:
    rows = [
        ScansRow("rover far", 10, 0.5, 0.6, 0.8, 1.0, 1.5),
        ScansRow("rover near", 30, 0.5, 0.8, 0.8, 2.0, 8.0),
    ]
    _, near, far, every, dearest = (
        " ".join(line.split()) for line in scans_table(rows).splitlines()
    )
    assert near == "rover near 30 0.500 0.800 0.800 0.000 2.00 8.00 4.00"
    assert far.startswith("rover far 10 0.500 0.600 0.800 0.200 ")
    assert every == "all 40 0.500 0.700 0.800 0.100 3.00 9.50 3.17"
    assert dearest == "dearest: rover near × 4.00"
