"""Record run A: one process publishes it, another records, over a router in this process.

Meanwhile a tail in a thread of this process writes the log into the databases. `Children` are
mapfold commands as child processes, which end with the demo, even when it is killed.
"""

import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from eventsrc.adapters.sim import SimulatedRun
from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset, RunId
from eventsrc.log import LogReader
from eventsrc.record.log_info import log_info
from eventsrc.record.transport.session import Router, ZenohOptions
from projections.fold.settings import Settings
from projections.postgres import TailReport, rebuild, tail
from projections.postgres.connection import Targets

from .folder import DemoFolder
from .progress import STALLED_S, Progress, cpu_steps, size_of

_END_S: Final = 10.0
_POLL_S: Final = 0.05


class Children:
    """Child processes that end with the ``with`` block: terminated, after 10 s killed."""

    def __init__(self) -> None:
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stderr: dict[str, Path] = {}

    def start(self, name: str, arguments: Sequence[str], stderr: Path) -> None:
        """Start ``mapfold *arguments``; its stderr goes to the file ``stderr``."""
        with stderr.open("wb") as errors:
            self._running[name] = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [sys.executable, "-m", "projections.surfaces.cli.child_process", *arguments],
                stdin=subprocess.PIPE,  # its end stops the child process
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        self._stderr[name] = stderr

    def wait(
        self,
        observe: Callable[[], Hashable],
        *,
        working: Sequence[str] = (),
        stalled_s: float = STALLED_S,
    ) -> None:
        """Wait until all have ended, however long it takes while there is progress: what
        ``observe`` returns changes, one of them ends or writes to stderr, or one that is named in
        ``working`` uses its processor. Raises MapfoldError if one fails or there is none for
        ``stalled_s`` seconds."""

        def seen() -> Hashable:
            written = tuple(map(size_of, self._stderr.values()))
            return observe(), written, tuple(self._names_running()), self._cpu_steps(working)

        progress = Progress(seen, stalled_s)
        pause = threading.Event()
        while names := self._names_running():
            self._check()
            if progress.is_stalled():
                raise MapfoldError(
                    f"mapfold {' and '.join(names)} made no progress for {stalled_s:g} s; "
                    f"see {self._stderr[names[0]]}"
                )
            pause.wait(_POLL_S)
        self._check()

    def wait_for_output(self, name: str, text: str, stalled_s: float = STALLED_S) -> None:
        """Wait until ``name`` has written ``text`` to stderr, while it writes or uses its
        processor; raises as `wait` does."""
        file = self._stderr[name]
        progress = Progress(lambda: (size_of(file), self._cpu_steps([name])), stalled_s)
        pause = threading.Event()
        while text not in file.read_text("utf-8", "replace"):
            self._check()
            if progress.is_stalled():
                raise MapfoldError(
                    f"mapfold {name} did not start: no progress for {stalled_s:g} s; see {file}"
                )
            pause.wait(_POLL_S)

    def _names_running(self) -> list[str]:
        return [name for name, process in self._running.items() if process.poll() is None]

    def _cpu_steps(self, names: Sequence[str]) -> tuple[int, ...]:
        return tuple(cpu_steps(self._running[name].pid) for name in names)

    def _check(self) -> None:
        for name, process in self._running.items():
            code = process.poll()
            if code:
                lines = self._stderr[name].read_text("utf-8", "replace").strip().splitlines()
                last_line = lines[-1] if lines else "no output"
                raise MapfoldError(f"mapfold {name} ended with exit {code}: {last_line}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        for process in self._running.values():
            process.terminate()  # does nothing to one that has ended
        for process in self._running.values():
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()  # not before: the end of its stdin is another SIGTERM


_ANY_PORT: Final = ZenohOptions(listen=("tcp/127.0.0.1:0",))
_WAIT_S: Final = 600
"""Seconds that the publisher waits for the recorder, which is running already."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """The numbers of published, recorded, rejected and lost envelopes.

    ``intact`` says that the log holds every payload, in order, byte for byte.
    """

    run_id: RunId
    published: int
    recorded: int
    intact: bool
    rejected: int
    lost: int
    drive_seconds: float
    log_bytes: int
    seconds: float


@dataclass(frozen=True, slots=True)
class Followed:
    """The tail's delays, from the recording of an event to its commit in the databases."""

    events: int
    batches: int
    median_delay_s: float
    worst_delay_s: float


def record_run(
    run: SimulatedRun,
    speed: float,
    folder: DemoFolder,
    targets: Targets,
    settings: Settings,
) -> tuple[Recorded, Followed]:
    """Publish run A, record it into the folder's log after the events there, and tail it into the
    databases."""
    started = time.monotonic()
    with LogReader(folder.log) as reader:
        before = reader.next_offset
    count = len(run.envelopes)
    drive_s = run.true_poses[-1].time_s
    with Router(_ANY_PORT) as router, Children() as children:
        connect = ("--connect", router.endpoints[0])
        children.start(
            "record",
            ("record", str(folder.log), *connect, "--max-events", str(count)),
            folder.stderr_of("record"),
        )
        children.wait_for_output("record", "recording")
        with BackgroundTail(folder.log, targets, settings) as background_tail:
            seed = str(run.house.seed)
            paced = ("--speed", str(speed), "--wait", str(_WAIT_S))
            children.start(
                "simulate",
                ("simulate", "--seed", seed, "--run", "a", *paced, *connect),
                folder.stderr_of("simulate"),
            )
            children.wait(
                lambda: (size_of(folder.log), background_tail.reached),
                working=["simulate"],
            )
            followed = background_tail.wait_for(Offset(before + count))
    seconds = time.monotonic() - started
    info = log_info(folder.log)
    with LogReader(folder.log) as reader:
        payloads = [event.payload for event in reader.read() if event.is_envelope]
    recorded = Recorded(
        run_id=run.run_id,
        published=count,
        recorded=len(payloads),
        intact=payloads == list(run.payloads),
        rejected=info.rejected,
        lost=info.lost,
        drive_seconds=drive_s,
        log_bytes=info.size_bytes,
        seconds=seconds,
    )
    return recorded, followed


class BackgroundTail:
    """A tail beside the recorder, in a thread of this process, for the length of a ``with`` block.

    It begins from an empty projection of this log, whatever the databases held before.
    """

    def __init__(self, log: Path, targets: Targets, settings: Settings) -> None:
        self._log, self._targets, self._settings = log, targets, settings
        self._stop = threading.Event()
        self._commits: list[tuple[Offset, int]] = []
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tail")
        self._running: Future[TailReport] | None = None

    def __enter__(self) -> Self:
        rebuild(self._log, self._targets, self._settings, until=FIRST_OFFSET)
        self._running = self._pool.submit(
            tail, self._log, self._targets, self._settings, stop=self._stop, on_batch=self._on_batch
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown()

    @property
    def reached(self) -> Offset:
        """The number of events that are in the databases."""
        return self._commits[-1][0] if self._commits else FIRST_OFFSET

    def wait_for(self, end: Offset) -> Followed:
        """Wait until ``end`` events are in the databases; returns the delays."""
        assert self._running is not None  # noqa: S101 - inside the with block
        progress, pause = Progress(lambda: self.reached), threading.Event()
        while self.reached < end:
            if self._running.done():
                self._running.result()  # raises the tail's error
            if progress.is_stalled():
                raise MapfoldError(
                    f"{self._log}: the databases are at event {self.reached} of {end}, without "
                    f"progress for {STALLED_S:g} s; run `{advised('status', self._log)}`"
                )
            pause.wait(_POLL_S)
        self._stop.set()
        report = self._running.result()
        delays = self._delays()
        return Followed(len(delays), report.batches, statistics.median(delays), max(delays))

    def _on_batch(self, report: TailReport) -> None:
        self._commits.append((report.next_offset, time.time_ns()))

    def _delays(self) -> list[float]:
        """Seconds for every envelope, from the log's time stamp to the commit that covers it."""
        delays: list[float] = []
        commits = iter(self._commits)
        reached, committed_ns = 0, 0
        with LogReader(self._log) as reader:
            for event in reader.read(FIRST_OFFSET, self._commits[-1][0]):
                while reached <= event.offset:
                    reached, committed_ns = next(commits)
                if event.is_envelope:
                    delays.append((committed_ns - event.logged_ns) / 1e9)
        return delays
