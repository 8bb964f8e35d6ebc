"""What a killed test run leaves behind is removed by the next one; what is in use is not."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from projections.postgres.embedded import EmbeddedServer
from tests.support.servers import furnish, hold_run, remove_killed_runs


@pytest.fixture
def parent() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="mapfold-test-runs-") as folder:
        yield Path(folder)


@pytest.fixture
def gone() -> int:
    """The number of a process that has ended."""
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    return ended.pid


def test_the_server_of_a_killed_run_is_stopped_and_its_folder_removed(
    parent: Path, gone: int
) -> None:
    home = parent / f"mapfold-test-{gone}"
    hold_run(home).close()
    server = EmbeddedServer(furnish(home / "kill-x")).start(keep=True)
    server.stop()
    assert server.running
    assert remove_killed_runs(parent) == [home]
    assert not server.running
    assert not home.exists()


def test_folders_in_use_are_left(parent: Path, gone: int) -> None:
    held, ours, other = (parent / f"mapfold-test-{name}" for name in (gone, os.getpid(), "home-x"))
    ours.mkdir()  # of a run that has just begun, without its lock
    other.mkdir()
    with hold_run(held):  # as a worker of a run whose first process was killed
        assert remove_killed_runs(parent) == []
    assert all(each.is_dir() for each in (held, ours, other))
    assert remove_killed_runs(parent) == [held]


@pytest.mark.slow
def test_a_folder_with_a_server_in_use_is_left(parent: Path, gone: int) -> None:
    home = parent / f"mapfold-test-{gone}"
    with EmbeddedServer(furnish(home)) as server:
        assert remove_killed_runs(parent) == []
        assert server.running
    assert remove_killed_runs(parent) == [home]
