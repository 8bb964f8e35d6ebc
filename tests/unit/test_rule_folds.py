"""Folds in several processes: of several errors the one of the first rules is raised."""

from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.model import Offset
from projections.history import rule_folds
from tests.support.worker_calls import fails_in_turn


@pytest.mark.seconds
def test_the_error_of_the_first_rules_is_raised_whichever_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def progress(folded: int, _: int) -> None:
        if folded >= 3:  # the second has reported 1, and 2 with its error
            (tmp_path / "go").touch()

    monkeypatch.setattr(rule_folds, "_fold_share", fails_in_turn)
    rules: Any = ["first", "second"]
    with pytest.raises(ValueError, match="first"):
        rule_folds.fold_all(tmp_path, rules, Offset(9), processes=2, progress=progress)
