"""Real Zenoh parts: a router on a free port, sessions connected to it, programs beside the test.

A certificate for 127.0.0.1 that no authority has signed, made by the openssl program.
"""

import functools
import os
import re
import shutil
import subprocess
import threading
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import pytest

from eventsrc.record.transport.session import Router, Session, ZenohOptions, open_session
from tests.support import prefork

MAPFOLD = "from projections.surfaces.cli import main; main()"
PUBLISHER = """
import sys
from eventsrc.record.transport.session import ZenohOptions, open_session
endpoint, key, *payloads = sys.argv[1:]
with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
    publisher = session.publisher(key)
    assert publisher.wait_for_subscriber(30.0)
    for payload in payloads:
        publisher.put(payload.encode())
    session.confirm()
"""
LONG_LEASE = Path(__file__).with_name("long_lease.json5")
LOOPBACK = ZenohOptions(listen=("tcp/127.0.0.1:0",), config_file=LONG_LEASE)
DEADLINE_S = 30.0
"""Longer than any wait in a healthy run; only a broken one ever waits that long."""
NEVER_S = 1e6
"""When a robot sends again what must be counted once."""


def scrape(port: int) -> dict[str, float]:
    """The samples a recorder's ``/metrics`` gives now, by name with labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=DEADLINE_S) as answer:
        text = answer.read().decode()
    samples = re.findall(r"^(\w+(?:\{.*\})?) (\S+)$", text, re.MULTILINE)
    return {name: float(value) for name, value in samples}


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
            open_session(ZenohOptions(connect=(endpoint,), config_file=LONG_LEASE), mode="client")
        )


class Program:
    """Python code in a process of its own; its stderr is read line by line.

    Without ``stdout``, a file descriptor, `output` returns what it wrote there.
    """

    def __init__(
        self,
        code: str,
        arguments: Sequence[str],
        *,
        stdout: int | None = None,
        env: Mapping[str, str] | None = None,
        cwd: Path | None = None,
    ) -> None:
        output, said = (os.pipe() if stdout is None else None), os.pipe()
        self.process = prefork.start(
            code,
            ["-c", *arguments],
            env=os.environ if env is None else env,
            cwd=cwd or Path.cwd(),
            stdout=stdout if output is None else output[1],
            stderr=said[1],
        )
        os.close(said[1])
        self._output: IO[str] | None = None
        if output is not None:
            os.close(output[1])
            self._output = os.fdopen(output[0])
        self.lines: list[str] = []
        self._said = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, args=(said[0],), daemon=True)
        self._reader.start()

    def _read(self, said: int) -> None:
        with os.fdopen(said) as stream:
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

    def end(self, number: int, within_s: float = DEADLINE_S) -> int:
        """Send a signal and return the exit code."""
        self.process.send_signal(number)
        return self.wait(within_s)

    def wait(self, within_s: float = DEADLINE_S) -> int:
        """The exit code, once it has ended and all it said is in ``lines``."""
        code = self.process.wait(within_s)
        self._reader.join(DEADLINE_S)
        return code

    def output(self) -> str:
        """What it wrote to stdout; call it after `wait`."""
        assert self._output is not None
        return self._output.read()

    def close(self) -> None:
        """Make sure that nothing is left behind."""
        self.process.kill()
        self.wait()
        if self._output is not None:
            self._output.close()


@pytest.fixture
def start_code() -> Iterator[Callable[..., Program]]:
    """Starts Python code with arguments; whatever still runs at the end of the test is killed."""
    with ExitStack() as programs:

        def run(code: str, *arguments: str) -> Program:
            program = Program(code, arguments)
            programs.callback(program.close)
            return program

        yield run


@pytest.fixture
def start(start_code: Callable[..., Program]) -> Callable[..., Program]:
    """Starts `mapfold …`."""
    return functools.partial(start_code, MAPFOLD)


@pytest.fixture
def publish(start_code: Callable[..., Program], endpoint: str) -> Callable[..., Program]:
    """Starts a program that publishes ``<payload> <payload> …`` (text) under a key, and ends."""
    return functools.partial(start_code, PUBLISHER, endpoint)


@dataclass(frozen=True)
class Certificate:
    """PEM files."""

    cert: Path
    key: Path


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Certificate:
    """A certificate of this test session's own, with its key."""
    return make_certificate(tmp_path_factory.mktemp("tls"))


def make_certificate(folder: Path) -> Certificate:
    """A new certificate, with its key, in ``folder``."""
    openssl = shutil.which("openssl")
    assert openssl, "these tests need the program openssl"
    made = Certificate(folder / "cert.pem", folder / "key.pem")
    subprocess.run(
        [
            *(openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"),
            *("-nodes", "-days", "2", "-subj", "/CN=mapfold test"),
            *("-addext", "subjectAltName=IP:127.0.0.1,DNS:localhost"),
            *("-keyout", str(made.key), "-out", str(made.cert)),
        ],
        check=True,
        capture_output=True,
    )
    return made
