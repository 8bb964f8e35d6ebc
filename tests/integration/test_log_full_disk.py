"""A full disk: one clear error, and everything synced stays readable.

RLIMIT_FSIZE makes writes fail in the middle of a record, as a full disk does. It holds for a whole
process, so each case runs in one of its own.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from eventsrc.base.errors import LogError
from eventsrc.log import LogWriter
from tests.support.fixtures_log import read_log
from tests.support.thorough import mostly_slow

ROOT = Path(__file__).parents[2]

FILL = """
import resource, sys
from pathlib import Path
from eventsrc.base.errors import LogError
from eventsrc.log import LogWriter, parse_fsync

resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
writer = LogWriter(Path(sys.argv[1]), fsync=parse_fsync("{fsync}"))
try:
    while True:
        writer.append("k", b"%08d" % writer.next_offset + b"x" * 900)
except LogError as error:
    print(writer.durable_offset)
    print(error)
    try:
        writer.append("k", b"more")
    except LogError:
        print("refused")
    try:
        writer.close()
    except LogError:
        pass
"""


def run(program: str, log: Path) -> str:
    """What a program prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program, str(log)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    ("limit", "fsync"),
    mostly_slow(
        [
            (20_500, "50ms"),
            (20_000, "always"),
            (1_000_000, "1ms"),
            *((limit, "1ms") for limit in (20_000, 20_500)),
            *((limit, "50ms") for limit in (20_000, 1_000_000)),
            *((limit, "always") for limit in (20_500, 1_000_000)),
        ]
    ),
)
def test_synced_events_stay(log_path: Path, limit: int, fsync: str) -> None:
    program = FILL.format(limit=limit, fsync=fsync)
    printed = run(program, log_path)
    durable, message, refused = printed.splitlines()
    assert "File too large" in message
    assert str(log_path) in message
    assert "Free space" in message
    assert refused == "refused"
    kept = read_log(log_path)
    assert [int(e.payload[:8]) for e in kept] == list(range(int(durable)))
    with LogWriter(log_path) as writer:
        assert writer.next_offset == int(durable)
        writer.append("k", b"after")
    assert [e.payload for e in read_log(log_path)][-1] == b"after"


@pytest.mark.slow
def test_a_failed_seal_loses_nothing(log_path: Path) -> None:
    """Compressed, the segment is larger than the limit: the active file stays and is read."""
    program = """
import random, resource, sys
from pathlib import Path
from eventsrc.base.errors import LogError
from eventsrc.log import LogWriter

writer = LogWriter(Path(sys.argv[1]), rotate_events=50)
rng = random.Random(1)
for _ in range(100):
    writer.append("k", rng.randbytes(1000))
    writer.sync()
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))
try:
    writer.close()
except LogError as error:
    print(error)
"""
    printed = run(program, log_path)
    assert "could not be sealed" in printed
    events = read_log(log_path)
    assert len(events) == 100
    LogWriter(log_path).close()
    assert read_log(log_path) == events
    assert not list(log_path.glob("*.active"))


def test_a_folder_that_cannot_be_made_is_a_one_line_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(LogError, match="Not a directory"):
        LogWriter(tmp_path / "file" / "log")
