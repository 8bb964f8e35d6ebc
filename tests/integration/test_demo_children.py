"""Processes that the demo starts end with it, also when it is killed outright."""

import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

from eventsrc.errors import LogBusy
from eventsrc.log import LogWriter
from eventsrc.transport.session import Router, ZenohOptions
from projections.demo.children import Children

STARTER = """
import sys
from pathlib import Path
from projections.demo.children import Children
log, endpoint, said = sys.argv[1:]
with Children() as children:
    children.start("record", ("record", log, "--connect", endpoint), Path(said))
    children.wait_for_output("record", "recording", 60)
    print("ready", flush=True)
    sys.stdin.read()
"""


def _wait_until_free(log: Path, timeout_s: float) -> None:
    """Take the writer's lock of the log as soon as nobody has it."""
    deadline = time.monotonic() + timeout_s
    while True:
        try:
            LogWriter(log).close()
        except LogBusy:
            assert time.monotonic() < deadline, "the recorder lives on"
            threading.Event().wait(0.02)
        else:
            return


def test_a_recorder_ends_cleanly_when_its_starter_is_killed(tmp_path: Path) -> None:
    log, said = tmp_path / "log", tmp_path / "said"
    with Router(ZenohOptions(listen=("tcp/127.0.0.1:0",))) as router:
        starter = subprocess.Popen(
            [sys.executable, "-c", STARTER, str(log), router.endpoints[0], str(said)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        try:
            assert starter.stdout is not None
            assert starter.stdout.readline() == b"ready\n"
            starter.send_signal(signal.SIGKILL)
            starter.wait(60)
            _wait_until_free(log, 60)
        finally:
            starter.kill()
            starter.communicate()
    assert said.read_text().splitlines()[-1].startswith(f"{log}: 0 recorded")


def test_leaving_the_block_ends_them_too(tmp_path: Path) -> None:
    said = tmp_path / "said"
    with Children() as children:
        children.start("router", ("router", "--listen", "tcp/127.0.0.1:0"), said)
        children.wait_for_output("router", "tcp/127.0.0.1", 60)
        (process,) = children._running.values()
    assert process.returncode == 0
