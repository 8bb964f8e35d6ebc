"""docs/time-travel.md is run, not trusted."""

import pytest

from projections.timetravel.expression import FUNCTIONS
from tests.docs.console import matches
from tests.docs.time_travel_page import DATA, FILES, PAGE, run_page


def test_its_commands_print_what_it_says() -> None:
    absent = [name for name in FILES if not (DATA / name).exists()]
    if absent:
        pytest.skip(f"{' and '.join(absent)} are absent from {DATA}; set MAPFOLD_SHARED_DATA")
    for command, code, printed in run_page():
        told = "\n".join(printed)
        assert code == 0, f"{command.text}\nexit {code}\n{told}"
        assert matches(command.prints, printed), f"{command.text}\nprinted:\n{told}"


def test_it_names_every_function_of_a_condition() -> None:
    text = PAGE.read_text("utf-8")
    for function in FUNCTIONS.values():
        assert f"| `{function.signature}` | {function.says} |" in text
