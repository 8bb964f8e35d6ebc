"""The turns and the table of ``scripts/bench_truth --lost``."""

from pathlib import Path

import pytest

from scripts.programs.bench.truth.losing import LostRow, lost_row, lost_table
from scripts.programs.bench.truth.worlds import make_case
from tests.programs.truth_cases import trial_generator


def test_the_table_adds_up() -> None:
    rows = [
        LostRow("a", 12, 10, 8, 8, 12, 0, [3, 5, 4], [0.1, 0.3, 0.2]),
        LostRow("b", 12, 9, 0, 0, 12, 1, [], []),
    ]
    text = lost_table(rows)
    assert text.splitlines()[-1].split() == [
        "all", "24", "19", "8", "8", "4", "0.20", "24", "1",
    ]  # fmt: skip
    assert "none" in text


@pytest.mark.slow
def test_a_robot_of_the_trial_data_is_told_where_it_is(tmp_path: Path) -> None:
    generator = trial_generator()
    case = make_case(generator, "rover", "aws_house", limit=200, cache=tmp_path)
    row = lost_row(generator, case, "aws_bookstore", 200, trials=3)
    assert (row.trials, row.strangers, row.strangers_told) == (3, 3, 0)
    assert row.right == row.told >= 1
