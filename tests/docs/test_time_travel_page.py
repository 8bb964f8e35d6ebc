"""docs/time-travel.md explains every condition; that its commands are true is tested with those of
the other documents."""

from projections.history.condition_functions import FUNCTIONS
from tests.docs.console import ROOT


def test_it_names_every_function_of_a_condition() -> None:
    text = (ROOT / "docs" / "time-travel.md").read_text("utf-8")
    for function in FUNCTIONS.values():
        assert f"| `{function.signature}` | {function.says} |" in text
