"""The programs of a simulated site: router, recorder and robots, each in a process of its own."""

import contextlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import urllib.request
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from tests.support.commands import cpu_seconds
from tests.support.fixtures_zenoh import MAPFOLD

ROOT = Path(__file__).parents[3]
START_S = 60.0
"""How long a program may take to start, or to end when it is asked to."""


def free_port() -> int:
    """A TCP port without a listener. A router keeps it across its restarts."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Process:
    """A program with its output in files, and the processor time of all its lives."""

    def __init__(self, name: str, command: list[str], folder: Path) -> None:
        self.name = name
        self.lives = 0
        self._command = command
        self._folder = folder
        self._used_s = 0.0
        self._process: subprocess.Popen[str] | None = None

    def start(self, *arguments: str) -> None:
        """Start it, with further arguments."""
        self.lives += 1
        self.output = self._folder / f"{self.name}-{self.lives}.out"
        self.errors = self._folder / f"{self.name}-{self.lives}.err"
        with self.output.open("w") as output, self.errors.open("w") as errors:
            self._process = subprocess.Popen(
                [*self._command, *arguments],
                cwd=ROOT,
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=errors,
                text=True,
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )

    @property
    def process(self) -> "subprocess.Popen[str]":
        """The one that runs, or that ran last."""
        assert self._process is not None, f"{self.name} was not started"
        return self._process

    def wait_for(self, text: str, path: Path) -> None:
        """Wait until ``text`` is in one of its outputs."""
        ticks = int(START_S / 0.05)
        for _ in range(ticks):
            if text in path.read_text():
                return
            with contextlib.suppress(subprocess.TimeoutExpired):
                code = self.process.wait(0.05)
                raise RuntimeError(f"{self.name} ended with {code}: {self.errors.read_text()}")
        raise RuntimeError(f"{self.name}: no {text!r} in {START_S:.0f} s: {path.read_text()}")

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        stdin = self.process.stdin
        assert stdin is not None
        stdin.write(line + "\n")
        stdin.flush()

    def cpu_s(self) -> float:
        """Processor time of all lives so far."""
        running = self._process is not None and self._process.returncode is None
        return self._used_s + (cpu_seconds(self.process.pid) if running else 0.0)

    def end(self, number: int, timeout_s: float = START_S) -> int:
        """Send a signal and wait for its end; the exit code."""
        self._used_s = self.cpu_s()
        self.process.send_signal(number)
        return self.wait(timeout_s)

    def wait(self, timeout_s: float = START_S) -> int:
        """Wait for its end; the exit code."""
        if self.process.returncode is None:
            self._used_s = max(self._used_s, self.cpu_s())
        code = self.process.wait(timeout_s)
        if self.process.stdin is not None:
            with contextlib.suppress(BrokenPipeError):
                self.process.stdin.close()
        return code

    def close(self) -> None:
        """Kill it if it still runs."""
        if self._process is not None and self._process.poll() is None:
            self.end(signal.SIGKILL)


@dataclass
class Site:
    """One site: its router, its recorder and the process of its robots."""

    number: int
    folder: Path
    robots: int
    per_second: float
    seconds: float
    spread: bool
    queue_peak: float = 0.0
    port: int = field(default_factory=free_port)
    metrics_port: int = field(default_factory=free_port)

    def __post_init__(self) -> None:
        python = [sys.executable, "-c", MAPFOLD]
        listen = ["router", "--listen", self.endpoint]
        self.router = Process(f"router-{self.number}", [*python, *listen], self.folder)
        record = ["record", str(self.log), "--connect", self.endpoint, "--key", self.key, "--json"]
        metrics = ["--metrics", str(self.metrics_port)]
        self.recorder = Process(
            f"recorder-{self.number}", [*python, *record, *metrics], self.folder
        )
        self.fleet = Process(
            f"robots-{self.number}",
            [sys.executable, "-m", "scripts.programs.fleet.robots"],
            self.folder,
        )

    @property
    def endpoint(self) -> str:
        """Where the router listens."""
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def key(self) -> str:
        """Under which the site's robots publish."""
        return f"site-{self.number}/detections"

    @property
    def log(self) -> Path:
        """The recorder's log."""
        return self.folder / f"site-{self.number}"

    @property
    def processes(self) -> tuple[Process, Process, Process]:
        """All three."""
        return self.router, self.recorder, self.fleet

    def start_router(self) -> None:
        """Start the router and wait until it listens."""
        self.router.start()
        self.router.wait_for("router listening", self.router.errors)

    def start_recorder(self) -> None:
        """Start the recorder and wait until it is subscribed."""
        self.recorder.start()
        self.recorder.wait_for("recording ", self.recorder.errors)

    def start_robots(self, seconds: float) -> None:
        """Start the robots, which wait for `go`. They go on with what is in their spools."""
        self.fleet.start(
            self.endpoint,
            self.key,
            str(self.number),
            str(self.robots),
            str(self.per_second),
            str(seconds),
            str(self.folder),
            str(self.fleet.lives + 1),
            "1" if self.spread else "0",
        )
        self.fleet.wait_for("ready", self.fleet.output)

    def go(self) -> None:
        """Let the robots publish."""
        self.fleet.tell("go")

    def fill_disk(self) -> None:
        """Let no file of the recorder grow by more than some kilobytes, as on a full disk."""
        largest = max((path.stat().st_size for path in self.log.glob("*.active")), default=0)
        limit = largest + 32 * 1024
        resource.prlimit(self.recorder.process.pid, resource.RLIMIT_FSIZE, (limit, limit))

    def sample(self) -> None:
        """Look at the depth of the recorder's queue."""
        with (
            contextlib.suppress(OSError),
            urllib.request.urlopen(
                f"http://127.0.0.1:{self.metrics_port}/metrics", timeout=2.0
            ) as answer,
        ):
            for line in answer.read().decode().splitlines():
                if line.startswith("mapfold_recorder_queue_depth "):
                    self.queue_peak = max(self.queue_peak, float(line.split()[1]))

    def robots_summary(self) -> dict[str, object]:
        """What the robots' last life said at its end."""
        lines = self.fleet.output.read_text().splitlines()
        summary: dict[str, object] = json.loads(lines[-1])
        return summary

    def close(self) -> None:
        """Kill what still runs."""
        for process in self.processes:
            process.close()


def read_errors(process: Process) -> list[str]:
    """The lines that all lives of a program wrote to stderr."""
    folder = process.errors.parent
    files = [folder / f"{process.name}-{life}.err" for life in range(1, process.lives + 1)]
    return [line for path in files for line in _lines(path.open())]


def _lines(stream: IO[str]) -> list[str]:
    with stream:
        return stream.read().splitlines()
