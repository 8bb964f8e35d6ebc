"""Real Zenoh parts: a router on a free port, sessions connected to it, programs beside the test."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from typing import IO

import pytest

from eventsrc._zenoh import Session, ZenohOptions, open_session
from eventsrc.router import Router

_MAPFOLD = "from projections.cli import main; main()"
LOOPBACK = ZenohOptions(listen=("tcp/127.0.0.1:0",))
DEADLINE_S = 30.0
"""Longer than any wait in a healthy run; only a broken one ever waits that long."""


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Where a router of the test's own listens."""
    with Router(LOOPBACK) as router:
        yield router.endpoints[0]


@pytest.fixture
def connected(endpoint: str) -> Iterator[Callable[[], Session]]:
    """Opens client sessions on the test's router; they are closed with the test."""
    with ExitStack() as sessions:
        yield lambda: sessions.enter_context(
            open_session(ZenohOptions(connect=(endpoint,)), mode="client")
        )


class Program:
    """A mapfold command in a process of its own; its stderr is read line by line."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", _MAPFOLD, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.lines: list[str] = []
        self._said = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, args=(self.process.stderr,), daemon=True)
        self._reader.start()

    def _read(self, stream: IO[str]) -> None:
        for line in stream:
            with self._said:
                self.lines.append(line.rstrip("\n"))
                self._said.notify_all()
        with self._said:
            self._ended = True
            self._said.notify_all()

    def wait_for(self, text: str) -> str:
        """The first line of stderr that holds ``text``; fails when the program ends without it."""
        with self._said:
            self._said.wait_for(lambda: self._line(text) or self._ended, DEADLINE_S)
            line = self._line(text)
        assert line is not None, f"no {text!r} in {self.lines}"
        return line

    def _line(self, text: str) -> str | None:
        return next((line for line in self.lines if text in line), None)

    def end(self, number: int) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """The exit code, once it has ended and all it said is in ``lines``."""
        code = self.process.wait(DEADLINE_S)
        self._reader.join(DEADLINE_S)
        return code

    def close(self) -> None:
        """Make sure that nothing is left behind."""
        self.process.kill()
        self.wait()
        for stream in (self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


@pytest.fixture
def start() -> Iterator[Callable[..., Program]]:
    """Starts `mapfold …` programs; whatever still runs at the end of the test is killed."""
    with ExitStack() as programs:

        def run(*arguments: str) -> Program:
            program = Program(arguments)
            programs.callback(program.close)
            return program

        yield run
