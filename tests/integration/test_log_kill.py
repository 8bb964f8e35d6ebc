"""kill -9 at random moments: no acknowledged event is lost or recorded twice.

`scripts/chaos_log` does the same for as long as one likes. `mapfold record` is killed in
`tests/chaos/test_recorder_kills.py`.
"""

import random
from pathlib import Path

import pytest

from eventsrc.log import verify_log
from tests.chaos.log_killer import lives

SEED = 20260324


@pytest.mark.parametrize(("fsync", "times"), [("5ms", 4), ("always", 3)])
def test_a_few_kills(log_path: Path, fsync: str, times: int) -> None:
    _kill(log_path, fsync, times)


@pytest.mark.slow
@pytest.mark.parametrize("fsync", ["always", "5ms", "50ms"])
def test_thirty_kills(log_path: Path, fsync: str) -> None:
    _kill(log_path, fsync, 30)


def _kill(log: Path, fsync: str, times: int) -> None:
    lived = list(lives(log, times, fsync, random.Random(SEED)))
    assert lived
    assert sum(life.acknowledged for life in lived) > 0
    assert [life.lost for life in lived] == [0] * len(lived)
    damage = {f.kind for f in verify_log(log).findings} - {"schema", "time"}
    assert damage == set()
