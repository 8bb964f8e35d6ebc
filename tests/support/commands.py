"""Run ``mapfold`` as a person would: a program of its own, with its own exit code and streams.

A program that says on stderr when it is ready, and ends at a signal.

How much memory a command takes at most, measured by itself.

Processor time of running processes and of the machine, from /proc.

Interrupts as those of Ctrl-C at any moment: a KeyboardInterrupt where Python handles signals.
"""

import inspect
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from pydantic_core import PydanticSerializationError

from projections.surfaces.cli import main
from tests.support import prefork
from tests.support.prefork import Process

PROGRAM = Path(sys.executable).with_name("mapfold")
TIMEOUT_S = 120


@dataclass(frozen=True)
class Said:
    """What a command said: its exit code, stdout for programs, stderr for people."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Stdout as one JSON document."""
        return json.loads(self.out)

    @property
    def lines(self) -> list[Any]:
        """Stdout as JSON lines."""
        return [json.loads(line) for line in self.out.splitlines()]


@dataclass(frozen=True)
class Commands:
    """Runs commands in one folder, whose ``.mapfold`` holds the embedded server."""

    folder: Path
    env: Mapping[str, str]

    @classmethod
    def in_folder(cls, folder: Path, **env: str) -> "Commands":
        """Commands that see no database of the caller's."""
        clean = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
        clean |= {"MAPFOLD_HOME": str(folder / "home"), "COLUMNS": "100", **env}
        return cls(folder, clean)

    @property
    def home(self) -> Path:
        """The home of the embedded server."""
        return Path(self.env["MAPFOLD_HOME"])

    def start(
        self, *args: str | Path, stdout: int | None = None, stderr: int | None = None
    ) -> prefork.Process:
        """Start ``mapfold *args`` with these file descriptors, or nothing, for its streams."""
        return prefork.start(
            prefork.MAPFOLD,
            [str(PROGRAM), *map(str, args)],
            env=self.env,
            cwd=self.folder,
            stdout=stdout,
            stderr=stderr,
        )

    def seconds(self, *args: str | Path) -> float:
        """How long ``mapfold *args`` takes here and now."""
        started = time.monotonic()
        self(*args)
        return time.monotonic() - started

    def __call__(self, *args: str | Path, stdin: bytes | None = None, code: int | None = 0) -> Said:
        """Run ``mapfold *args``; with ``code`` given, anything else it exits with is a failure."""
        done = prefork.run(
            prefork.MAPFOLD,
            [str(PROGRAM), *map(str, args)],
            env=self.env,
            cwd=self.folder,
            stdin=stdin,
            timeout=TIMEOUT_S,
        )
        said = Said(done.returncode, done.stdout.decode(), done.stderr.decode())
        assert "Traceback" not in said.err, said.err
        assert code is None or said.code == code, f"exit {said.code}: {said.err or said.out}"
        return said


class ReadyProgram:
    """``program``, whose stderr is the write end of a pipe to ``read_end``; what it says to people
    is in ``said``. Waits until it names Ctrl-C or is gone."""

    def __init__(self, program: Process, read_end: int, ready_s: float, end_s: float) -> None:
        self.program, self._end_s = program, end_s
        self._stderr = os.fdopen(read_end)
        self.said: list[str] = []
        self._ready = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        assert self._ready.wait(ready_s), self.text

    @property
    def text(self) -> str:
        """What it has said to people."""
        return "\n".join(self.said)

    def _read(self) -> None:
        with self._stderr:
            for line in self._stderr:
                self.said.append(line.rstrip("\n"))
                if "Ctrl-C" in line:
                    self._ready.set()
        self._ready.set()

    def end(self) -> int:
        """SIGTERM; its exit code."""
        self.program.send_signal(signal.SIGTERM)
        try:
            return int(self.program.wait(self._end_s))
        finally:
            self.program.kill()
            self.program.wait()
            self._reader.join()


MOST_MIB = 600
"""What any command that reads may take, whatever it is given."""


@dataclass(frozen=True)
class Ran:
    """How a command ended."""

    code: int
    said: str
    peak_mib: float


def run_measured(*arguments: str | Path, timeout_s: float = 240.0) -> Ran:
    """Run ``mapfold arguments`` in a process of its own."""
    done = prefork.run(
        "tests.support.commands:main_measured",
        ["mapfold", *map(str, arguments)],
        env=os.environ,
        cwd=Path.cwd(),
        timeout=timeout_s,
    )
    *said, last = done.stderr.decode().splitlines()
    assert last.startswith("VmHWM:"), done.stderr
    return Ran(done.returncode, done.stdout.decode() + "\n".join(said), int(last.split()[1]) / 1024)


def main_measured() -> None:
    """Run the command line in this process and print the most memory it took to stderr."""
    try:
        main()
    finally:
        # Not ru_maxrss, which begins with what the parent took.
        (line,) = [x for x in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in x]
        print(line, file=sys.stderr)


_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pid: int) -> float:
    """What a process has used so far with all its threads, those that ended included; 0 where there
    is no /proc."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return 0.0
    fields = stat.rpartition(")")[2].split()  # its name may hold blanks and brackets
    return (int(fields[11]) + int(fields[12])) / _TICKS


def family_cpu_seconds(pid: int) -> float:
    """That of a process and of its children, those that ended and were waited for included."""
    total = 0.0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue  # it has just ended
        if int(stat.parent.name) == pid:
            total += sum(map(int, fields[11:15]))
        elif int(fields[1]) == pid:
            total += sum(map(int, fields[11:13]))
    return total / _TICKS


class UnusedCpu(NamedTuple):
    """Processor time that no program got, in seconds summed over all processors: idle, idle while
    a program waited for the disk, and taken by the host of a virtual machine ("steal")."""

    idle: float
    disk: float
    host: float

    def since(self, before: "UnusedCpu") -> "UnusedCpu":
        """The difference to an earlier reading."""
        return UnusedCpu(*(b - a for a, b in zip(before, self, strict=True)))


def unused_cpu() -> UnusedCpu | None:
    """The machine's unused processor time since its start; None where there is no /proc/stat."""
    try:
        first = Path("/proc/stat").read_text().splitlines()[0]
    except FileNotFoundError:
        return None
    ticks = list(map(int, first.split()[1:]))
    return UnusedCpu(ticks[3] / _TICKS, ticks[4] / _TICKS, ticks[7] / _TICKS)


def reports_exceptions(frame: FrameType) -> bool:
    """Whether Python may report an exception from it instead of raising it: it is a ``__del__``, or
    a generator, which is closed when it is freed and needs no more of it."""
    code = frame.f_code
    return code.co_name == "__del__" or bool(code.co_flags & inspect.CO_GENERATOR)


class Moments:
    """The moments at which a signal may be handled: where a function begins or ends.

    They are numbered from 1 while `passing` runs something. At the moment ``interrupt`` it is
    interrupted. ``marks`` are the moments at which functions called ``mark`` began.
    """

    def __init__(self, interrupt: int | None = None, mark: str = "") -> None:
        self._interrupt, self._mark = interrupt, mark
        self.count = 0
        self.marks: list[int] = []

    @contextmanager
    def passing(self) -> Iterator[None]:
        """Count the moments of a block, which the interrupt ends, if it comes."""
        sys.setprofile(self._pass)
        try:
            yield
        except (KeyboardInterrupt, PydanticSerializationError):  # what pydantic makes of it
            if self._interrupt is None or self.count < self._interrupt:
                raise
        finally:
            sys.setprofile(None)

    def _pass(self, frame: FrameType, event: str, _: Any) -> None:
        if event == "c_call" or reports_exceptions(frame):  # no moment before a C call
            return
        self.count += 1
        if event == "call" and frame.f_code.co_name == self._mark:
            self.marks.append(self.count)
        if self.count == self._interrupt:
            sys.setprofile(None)
            raise KeyboardInterrupt


def moments_of(work: Callable[[], object], mark: str = "") -> Moments:
    """The moments of some work that is not interrupted."""
    found = Moments(mark=mark)
    with found.passing():
        work()
    return found


def interrupt(work: Callable[[], object], moment: int) -> None:
    """Begin some work and interrupt it at a moment."""
    with Moments(moment).passing():
        work()
