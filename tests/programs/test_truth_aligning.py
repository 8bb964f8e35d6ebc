"""The table of runs that find each other: errors are those of the frame that was made."""

from dataclasses import replace

import pytest

from projections.fold.settings import CameraConstants
from projections.localize.evaluate.truth import Truth
from scripts.programs.bench.truth.aligning import AlignRow, align_rows, align_table
from scripts.programs.bench.truth.worlds import Case
from tests.support.folds import accepted
from tests.support.logs import simulated


def house(seed: int) -> Case:
    """Both runs of a simulated house."""
    runs = [simulated(seed, run) for run in "ab"]
    events = [accepted(envelope) for run in runs for envelope in run.envelopes]
    return Case(f"robot house-{seed}", CameraConstants(), events, Truth({}), {}, runs[0].run_id, {})


@pytest.mark.slow
def test_a_run_in_a_frame_of_its_own_is_scored_by_that_frame() -> None:
    rows = list(align_rows([house(7), house(3)], seed=1))
    own = [row for row in rows if row.error_m is not None and row.is_whole]
    assert [row.is_right for row in own] == [True, True]
    assert len([row for row in rows if row.in_common is None]) == 4 * 4 * 4
    text = align_table(rows)
    assert "whole runs: 2 of 2 are sure, 2 of them right" in text
    assert "other buildings, whole: 4: 0 sure" in text
    assert "other buildings, thirds: 60: 0 sure" in text


def test_a_wrong_transform_counts_as_wrong() -> None:
    row = AlignRow("rover house b", True, 30, "sure", 20, 90.0, 3.0, 0.1, 2.0, 0.5)
    assert not row.is_right
    assert "whole runs: 1 of 1 are sure, 0 of them right" in align_table([row])
    part = replace(row, is_whole=False, in_common=12)
    unknown = AlignRow("rover house b", True, 0, "unknown")
    text = align_table([part, unknown])
    assert "whole runs: none of 1 is sure" in text
    assert "thirds with 12 to 19 things in common: 0 of 1 sure and right, 1 sure and wrong" in text
