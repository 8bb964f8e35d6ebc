"""kill -9 on `mapfold record` under load at random moments: no acknowledged event is lost, and none
counts twice. `scripts/chaos_recorder` does the same for as long as one likes."""

import time
from pathlib import Path

import pytest

from scripts.programs.chaos.recorder_killer import kill_side_by_side
from tests.support.thorough import rounds


def test_a_few_kills(tmp_path: Path) -> None:
    _kill(tmp_path, rounds(6, 2), 1, 300.0, 20260324)


@pytest.mark.slow
def test_forty_kills(tmp_path: Path) -> None:
    _kill(tmp_path, 40, 2, 750.0, time.time_ns() % 10**6)


def _kill(folder: Path, kills: int, lanes: int, rate: float, seed: int) -> None:
    print(f"scripts/chaos_recorder --kills {kills} --lanes {lanes} --rate {rate} --seed {seed}")
    tally = kill_side_by_side(folder, kills, lanes=lanes, rate=rate, seed=f"{seed}/0")
    assert tally.good, tally
    assert tally.kills == kills
    assert tally.envelopes > 0, "the recorders lived long enough to acknowledge something"
    assert tally.commands > 0
