"""`mapfold router` in a process of its own."""

import signal
import subprocess
import sys
from collections.abc import Callable

import pytest

from eventsrc.record.transport.session import ZenohOptions, open_session
from tests.docs.console import ROOT
from tests.support.fixtures_zenoh import DEADLINE_S, Program

Start = Callable[..., Program]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_says_where_it_listens_and_ends_cleanly(start: Start, number: int) -> None:
    program = start("router", "--listen", "tcp/127.0.0.1:0")
    endpoint = program.wait_for("router listening on").split()[3].rstrip(";")
    with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
        assert session.is_connected
    assert program.end(number) == 0
    assert program.lines[-1] == "router ended"


_SIGNAL_IN_ANOTHER_THREAD = """
import signal, threading
from projections.surfaces.cli.signals import stop_on_signals

def hit(stop):
    while not stop._cond._waiters:
        pass
    signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
    threading.Event().wait()

with stop_on_signals() as stop:
    threading.Thread(target=hit, args=(stop,), daemon=True).start()
    stop.wait()
"""


def test_a_signal_that_another_thread_gets_is_not_waited_past() -> None:
    """Zenoh has threads of its own, and a signal may come just before the wait for it."""
    command = [sys.executable, "-c", _SIGNAL_IN_ANOTHER_THREAD]
    assert subprocess.run(command, timeout=DEADLINE_S, cwd=ROOT, check=False).returncode == 0


def test_a_busy_port_is_one_line_and_exit_1(start: Start, endpoint: str) -> None:
    program = start("router", "--listen", endpoint)
    assert program.wait() == 1
    (line,) = program.lines
    assert line.startswith(f"mapfold: cannot listen on {endpoint}")
