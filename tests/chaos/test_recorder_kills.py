"""kill -9 on `mapfold record` under load at random moments: no acknowledged event is lost, and none
counts twice. `scripts/chaos_recorder` does the same for as long as one likes."""

import random
import time
from pathlib import Path

import pytest

from tests.thorough import rounds

from .recorder_killer import Ordeal


def test_a_few_kills(tmp_path: Path) -> None:
    _kill(tmp_path, rounds(6, 4), 300, 20260324)


@pytest.mark.slow
def test_thirty_kills(tmp_path: Path) -> None:
    _kill(tmp_path, 30, 1_500, time.time_ns() % 10**6)


def _kill(folder: Path, times: int, per_second: int, seed: int) -> None:
    print(f"scripts/chaos_recorder --times {times} --rate {per_second} --seed {seed}")
    with Ordeal(folder, per_second, random.Random(seed)) as ordeal:
        lives = list(ordeal.lives(times))
        end = ordeal.end()
    assert [life.lost for life in lives] == [0] * len(lives)
    assert lives[-1].promised > 0, "the recorders lived long enough to promise something"
    assert end.good, end
