"""Processes that the demo starts end with it, also when it is killed outright."""

import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from eventsrc.adapters.sim import simulate_run
from eventsrc.base.errors import LogBusy, MapfoldError
from eventsrc.log import LogWriter
from eventsrc.record.transport.session import Router, ZenohOptions
from projections.postgres.connection import Targets
from projections.surfaces.demo import recorded_run
from projections.surfaces.demo.recorded_run import Children, record_run
from tests.support.fixtures_zenoh import Program

STARTER = """
import signal, sys
from pathlib import Path
from projections.postgres.connection import Targets
from projections.surfaces.demo import recorded_run
from projections.surfaces.demo.recorded_run import Children, record_run
log, endpoint, said = sys.argv[1:]
with Children() as children:
    children.start("record", ("record", log, "--connect", endpoint), Path(said))
    children.wait_for_output("record", "recording")
    print("ready", file=sys.stderr, flush=True)
    signal.pause()
"""


def _wait_until_free(log: Path, timeout_s: float) -> None:
    """Take the writer's lock of the log as soon as it is free."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            LogWriter(log).close()
        except LogBusy:
            assert time.monotonic() < deadline, "the recorder lives on"
            threading.Event().wait(0.02)
        else:
            return


def test_a_recorder_ends_cleanly_when_its_starter_is_killed(
    start_code: Callable[..., Program], tmp_path: Path
) -> None:
    log, said = tmp_path / "log", tmp_path / "said"
    with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router:
        starter = start_code(STARTER, str(log), router.endpoints[0], str(said))
        starter.wait_for("ready")
        starter.end(signal.SIGKILL)
        _wait_until_free(log, 60)
    assert said.read_text().splitlines()[-1].startswith(f"{log}: 0 recorded")


def test_a_process_that_makes_no_progress_is_given_up(tmp_path: Path) -> None:
    """One that waits for messages that never come, and one stopped before it started; both end
    with the block."""
    said = tmp_path / "said"
    with Children() as children:
        children.start("router", ("router", "--listen", "tcp/127.0.0.1:0"), said)
        children.wait_for_output("router", "tcp/127.0.0.1")
        with pytest.raises(MapfoldError, match=r"no progress for 0\.3 s by mapfold router; see"):
            children.wait(lambda: False, stalled_s=0.3)
        children.start("record", ("record", str(tmp_path / "log")), tmp_path / "other")
        (router, _), (process, _) = children._all.values()
        process.send_signal(signal.SIGSTOP)
        try:
            with pytest.raises(MapfoldError, match=r"0\.3 s by mapfold router and record; see"):
                children.wait_for_output("record", "recording", stalled_s=0.3)
        finally:
            process.send_signal(signal.SIGCONT)
    assert router.returncode == 0
    assert process.returncode is not None


@pytest.mark.slow
def test_waiting_goes_on_as_long_as_there_is_progress(tmp_path: Path) -> None:
    """What is observed changes all the time, so ten times the bound is no reason to give up."""
    seen = iter(range(10**9))
    ended = threading.Event()
    with Children() as children:
        children.start("router", ("router", "--listen", "tcp/127.0.0.1:0"), tmp_path / "said")
        children.wait_for_output("router", "tcp/127.0.0.1")
        ((process, _),) = children._all.values()
        started = time.monotonic()

        def observe() -> int:
            if time.monotonic() - started > 1.0 and not ended.is_set():
                ended.set()
                process.terminate()
            return next(seen)

        children.wait(lambda: not children.running, observe=observe, stalled_s=0.1)
    assert ended.is_set()


def test_what_is_waited_for_last_is_named_when_no_child_runs(tmp_path: Path) -> None:
    with Children() as children, pytest.raises(MapfoldError, match=r"0\.1 s by the databases$"):
        children.wait(lambda: False, stalled_s=0.1, at_last="the databases")


@pytest.mark.seconds
def test_a_signal_while_the_tail_is_started_ends_it(
    tmp_path: Path, module_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Interrupted(ThreadPoolExecutor):
        def submit(self, *args: Any, **kwargs: Any) -> Any:
            super().submit(*args, **kwargs)
            raise SystemExit(128 + signal.SIGTERM)  # as the handler does

    monkeypatch.setattr(recorded_run, "ThreadPoolExecutor", Interrupted)
    with pytest.raises(SystemExit):
        record_run(simulate_run(7, "a"), 300.0, tmp_path, module_database)
    _wait_until_free(tmp_path / "log", 30.0)
