"""docs/time-travel.md is run, not trusted."""

import pytest

from projections.timetravel.expression import FUNCTIONS
from tests.docs.console import Command, matches, read, run
from tests.docs.time_travel_page import DATA, FILES, PAGE, run_page


def test_its_commands_print_what_it_says() -> None:
    absent = [name for name in FILES if not (DATA / name).exists()]
    if absent:
        pytest.skip(f"{' and '.join(absent)} are absent from {DATA}; set MAPFOLD_SHARED_DATA")
    for command, code, printed in run_page():
        told = "\n".join(printed)
        assert code == 0, f"{command.text}\nexit {code}\n{told}"
        assert matches(command.prints, printed), f"{command.text}\nprinted:\n{told}"


def test_its_commands_on_the_sample_log_need_no_trial_data() -> None:
    parts = [
        part for part in read(PAGE) if isinstance(part, Command) and "logs/sample" in part.text
    ]
    assert parts
    for command, code, printed in run([*parts]):
        assert code == 0
        assert matches(command.prints, printed), "\n".join(printed)


def test_it_names_every_function_of_a_condition() -> None:
    text = PAGE.read_text("utf-8")
    for function in FUNCTIONS.values():
        assert f"| `{function.signature}` | {function.says} |" in text
