"""`mapfold router` in a process of its own."""

import signal
from collections.abc import Callable

import pytest

from eventsrc._zenoh import ZenohOptions, open_session
from tests.fixtures_zenoh import Program

Start = Callable[..., Program]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_says_where_it_listens_and_ends_cleanly(start: Start, number: int) -> None:
    program = start("router", "--listen", "tcp/127.0.0.1:0")
    endpoint = program.wait_for("router listening on").split()[3].rstrip(";")
    with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
        assert session.linked
    assert program.end(number) == 0
    assert program.lines[-1] == "router ended"


def test_a_busy_port_is_one_line_and_exit_1(start: Start, endpoint: str) -> None:
    program = start("router", "--listen", endpoint)
    assert program.wait() == 1
    (line,) = program.lines
    assert line.startswith(f"mapfold: cannot listen on {endpoint}")
