"""A log says its settings: a newcomer who follows README, tour and demo types none."""

from pathlib import Path

import pytest

from tests.docs.console import ROOT

READ = ("README.md", "docs/tour.md", "docs/index.md", "scripts/demo", "logs/README.md")
DEMO = sorted((ROOT / "projections" / "surfaces" / "demo").glob("*.py"))


@pytest.mark.parametrize("path", [*(ROOT / name for name in READ), *DEMO], ids=lambda p: p.name)
def test_nothing_is_set_by_an_option(path: Path) -> None:
    text = path.read_text("utf-8")
    assert "--set " not in text
    assert "--settings" not in text
    assert "--set=" not in text
