"""The table of runs that find each other: errors are those of the frame that was made."""

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
    rows = align_rows([house(7), house(3)], seed=1)
    own = [row for row in rows if row.error_m is not None]
    assert [row.is_right for row in own] == [True, True]
    assert len([row for row in rows if " in " in row.name]) == 2
    text = align_table(rows)
    assert "2 of 2 runs are sure, 2 of them right" in text
    assert "2 of other buildings: 0 sure" in text


def test_a_wrong_transform_counts_as_wrong() -> None:
    row = AlignRow("rover house b", "sure", 20, 90.0, 3.0, 0.1, 2.0, 0.5)
    assert not row.is_right
    assert "1 of 1 runs are sure, 0 of them right" in align_table([row])
    unknown = AlignRow("rover house b", "unknown", 0, 0.0, 0.0, 9.0)
    assert align_table([unknown]).endswith("none is sure")
