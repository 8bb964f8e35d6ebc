"""The differential test itself: ways agree on a log, and one that differs is found and shown."""

import re
from pathlib import Path
from typing import Any

import pytest

from projections.map.view import MapView
from projections.store.history_recorder import map_after
from scripts.programs.differ.__main__ import main
from scripts.programs.differ.growing_log import GrowingLog
from tests.support.thorough import rounds


@pytest.mark.seconds
def test_all_ways_agree_on_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    events = str(rounds(20, 6))
    assert main(["--seed", "1", "--log", "1", "--events", events, "--without", "databases"]) == 0
    assert "1 logs" in capsys.readouterr().out


@pytest.mark.slow
def test_all_ways_agree_on_a_log_and_in_databases() -> None:
    assert main(["--seed", "1", "--log", "2", "--events", "40"]) == 0


@pytest.mark.seconds
def test_a_way_that_differs_is_found_and_its_shortest_log_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def late(reader: Any, settings: Any, end: Any, **more: Any) -> MapView:
        return map_after(reader, settings, max(end - 1, 0), **more)

    monkeypatch.setattr("scripts.programs.differ.timelines.map_after", late)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert main(["--seed", "1", "--log", "1", "--events", "20", "--without", "databases"]) == 1
    said = capsys.readouterr().out
    assert "one question, at" in said
    assert "to repeat: scripts/differ --seed 1 --log 1 --events 5" in said
    (kept,) = re.findall(r"it is kept at (\S+)", said)
    assert [path for path in Path(kept).iterdir() if ".mcap" in path.name]


def test_a_longer_log_begins_as_a_shorter_one(tmp_path: Path) -> None:
    logs = [GrowingLog(tmp_path / str(count), 5, count) for count in (10, 30)]
    short, long = ([*log.grow()] for log in logs)
    assert 0 < short[-1] < long[-1]
