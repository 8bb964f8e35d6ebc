"""The pool of processes: results, killed workers, faults, and no process left behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from eventsrc.base.errors import MisuseError
from projections.adapters.fleet.engines import RETRIES, Ended, LocalPool
from projections.surfaces.cli.fleet_options import open_engine
from tests.support.fleet_tasks import double, fails, killed

WAIT_S = 60.0


@pytest.mark.seconds
def test_each_request_has_one_result_whichever_worker_is_killed(tmp_path: Path) -> None:
    kills = [0, 1, 0, RETRIES + 1]
    seen: list[int] = []
    with LocalPool(2) as pool:
        requests = [(tmp_path, number, times) for number, times in enumerate(kills)]
        ended = sorted(pool.run(killed, requests), key=lambda each: each.index)
        doubled = sorted(pool.run(double, [5, 7], seen.append), key=lambda each: each.index)

    assert ended[:3] == [
        Ended(number, number, None, times + 1) for number, times in enumerate(kills[:3])
    ]
    assert ended[3].result is None
    assert ended[3].attempts == RETRIES + 1
    assert ended[3].error is not None
    assert ended[3].error.startswith("its worker process was killed 3 times; out of memory?")
    # Beside a worker that was killed no other site was begun again.
    begun = [(tmp_path / str(number)).stat().st_size for number in range(4)]
    assert begun == [1, 2, 1, RETRIES + 1]
    assert doubled == [Ended(0, 10, None, 1), Ended(1, 14, None, 1)]
    assert seen[-1] == 12


@pytest.mark.seconds
def test_a_fault_is_an_error_of_its_site_alone() -> None:
    with LocalPool(1) as pool:
        [ended] = pool.run(fails, [3])
    assert ended == Ended(
        0, None, "a fault in mapfold: RuntimeError: no 3\x1b[31m", 1
    )  # the command escapes what it prints


_PARENT = """
import sys
from pathlib import Path
from projections.adapters.fleet.engines import LocalPool
from tests.support.fleet_tasks import wait
if __name__ == "__main__":
    with LocalPool(1) as pool:
        list(pool.run(wait, [Path(sys.argv[1])]))
"""


@pytest.mark.seconds
@pytest.mark.parametrize(
    "signum", [signal.SIGKILL, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_workers_end_with_their_parent_however_that_ends(
    tmp_path: Path, signum: signal.Signals
) -> None:
    program = tmp_path / "parent.py"
    program.write_text(_PARENT)
    root = Path(__file__).parents[2]
    parent = subprocess.Popen(
        [sys.executable, str(program), str(tmp_path)],
        env=os.environ | {"PYTHONPATH": str(root)},
        start_new_session=True,
        stderr=subprocess.DEVNULL,
    )
    try:
        worker = int(_when_there(tmp_path / "pid"))
        os.killpg(parent.pid, signum) if signum == signal.SIGINT else parent.kill()
        parent.wait(WAIT_S)
        deadline = time.monotonic() + WAIT_S
        while _runs(worker):
            assert time.monotonic() < deadline, "the worker outlived its parent"
            os.sched_yield()
    finally:
        parent.kill()
        parent.wait()


def _when_there(path: Path) -> str:
    deadline = time.monotonic() + WAIT_S
    while not path.exists():
        assert time.monotonic() < deadline
        os.sched_yield()
    return path.read_text()


def _runs(pid: int) -> bool:
    """Whether a process is there and no zombie, which process 1 of a container may leave."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_a_cluster_without_its_package_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MisuseError, match=r"pip install 'mapfold\[cluster\]'"):
        open_engine("dask://h:1", None, 1)


@pytest.mark.parametrize("engine", ["ray", "dask", "dask://", "http://h:1", ""])
def test_other_engines_are_refused(engine: str) -> None:
    with pytest.raises(MisuseError, match="there are local and dask://HOST:PORT"):
        open_engine(engine, None, 1)
