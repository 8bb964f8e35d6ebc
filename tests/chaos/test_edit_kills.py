"""kill -9 on tail, recorder and server while commands arrive: none is lost or counts twice."""

import random
import time
from pathlib import Path

import pytest

from projections.postgres.connection import Targets
from scripts.programs.chaos.edit_killer import Ordeal


@pytest.mark.slow
def test_a_few_kills(tmp_path: Path, third_database: Targets) -> None:
    _kill(tmp_path, third_database, 6, 20260324)


@pytest.mark.slow
@pytest.mark.timeout(3_600)
def test_two_hundred_kills(tmp_path: Path, third_database: Targets) -> None:
    _kill(tmp_path, third_database, 200, time.time_ns() % 10**6)


def _kill(folder: Path, fresh: Targets, rounds: int, seed: int) -> None:
    print(f"python -m scripts.programs.chaos.edit_killer --rounds {rounds} --seed {seed}")
    with Ordeal(folder, random.Random(seed), fresh) as ordeal:
        ordeal.run(rounds)
        tally = ordeal.tally
    assert tally.good, tally
    assert tally.rounds == rounds
    assert tally.acknowledged > 0, "the recorders lived long enough to take commands"
    assert tally.joined > 0, "the frame of the second robot was joined to the map's"
