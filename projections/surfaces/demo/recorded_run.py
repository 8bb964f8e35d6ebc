"""Record run A: one process publishes it, another records, over a router in this process.

Meanwhile a tail in a thread of this process writes the log into the databases. `Children` are
mapfold commands as child processes, which end with the demo, even when it is killed. On a busy
machine a fixed deadline would end work that proceeds: waiting ends when nothing has changed for
`STALLED_S`.
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

STALLED_S: Final = 180.0
_END_S: Final = 10.0
_POLL_S: Final = 0.05
_ANY_PORT: Final = ZenohOptions(listen=("tcp/127.0.0.1:0",))
_WAIT_S: Final = 600
"""Seconds that the publisher waits for the recorder, which is running already."""


def wait_until(
    done: Callable[[], bool],
    observe: Callable[[], Hashable],
    complaint: Callable[[], str],
    stalled_s: float = STALLED_S,
) -> None:
    """Wait until ``done``. Raises MapfoldError with ``complaint`` when what ``observe`` returns has
    not changed for ``stalled_s`` seconds."""
    pause = threading.Event()
    seen, since = observe(), time.monotonic()
    while not done():
        now = observe()
        if now != seen:
            seen, since = now, time.monotonic()
        elif time.monotonic() - since > stalled_s:
            raise MapfoldError(complaint())
        pause.wait(_POLL_S)


class Children:
    """Child processes that end with the ``with`` block: terminated, after 10 s killed."""

    def __init__(self) -> None:
        self._all: dict[str, tuple[subprocess.Popen[bytes], Path]] = {}

    def start(self, name: str, arguments: Sequence[str], stderr: Path) -> None:
        """Start ``mapfold *arguments``; its stderr goes to the file ``stderr``."""
        program = [sys.executable, "-m", "projections.surfaces.cli", "--ends-with-stdin"]
        with stderr.open("wb") as errors:
            child = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [*program, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        self._all[name] = child, stderr

    def wait(
        self,
        done: Callable[[], bool] | None = None,
        observe: Callable[[], Hashable] = lambda: None,
        stalled_s: float = STALLED_S,
    ) -> None:
        """Wait until ``done``, by default until all have ended, while there is progress: what
        ``observe`` returns changes, or a child ends or writes to stderr. Raises MapfoldError if a
        child fails or there is no progress for ``stalled_s`` seconds."""

        def finished() -> bool:
            over = done() if done is not None else not self._running()
            self._check()
            return over

        def seen() -> Hashable:
            each = ((p.poll(), err.stat().st_size) for p, err in self._all.values())
            return observe(), tuple(each)

        def complaint() -> str:
            names = self._running() or list(self._all)
            return (
                f"mapfold {' and '.join(names)} made no progress for {stalled_s:g} s; see "
                f"{self._all[names[-1]][1]}"
            )

        wait_until(finished, seen, complaint, stalled_s)

    def wait_for_output(self, name: str, text: str, stalled_s: float = STALLED_S) -> None:
        """Wait until ``name`` has written ``text`` to stderr; raises as `wait` does."""
        _, file = self._all[name]
        self.wait(lambda: text in file.read_text("utf-8", "replace"), stalled_s=stalled_s)

    def _running(self) -> list[str]:
        return [name for name, (process, _) in self._all.items() if process.poll() is None]

    def _check(self) -> None:
        for name, (process, stderr) in self._all.items():
            code = process.poll()
            if code:
                lines = stderr.read_text("utf-8", "replace").strip().splitlines()
                last_line = lines[-1] if lines else "no output"
                raise MapfoldError(f"mapfold {name} ended with exit {code}: {last_line}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        processes = [process for process, _ in self._all.values()]
        for process in processes:
            process.terminate()  # does nothing to one that has ended
        for process in processes:
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()  # not before: the end of its stdin is another SIGTERM


@dataclass(frozen=True, slots=True)
class RecordedRun:
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
    run: SimulatedRun, speed: float, folder: Path, targets: Targets, settings: Settings
) -> tuple[RecordedRun, Followed]:
    """Publish run A, record it into ``folder/log`` after the events there, and tail it into the
    databases."""
    started, log = time.monotonic(), folder / "log"
    with LogReader(log) as reader:
        before = reader.next_offset
    count = len(run.envelopes)
    with Router(_ANY_PORT) as router, Children() as children:
        connect = ("--connect", router.endpoints[0])
        recorder = ("record", str(log), *connect, "--max-events", str(count))
        children.start("record", recorder, folder / "record.txt")
        children.wait_for_output("record", "recording")
        with BackgroundTail(log, targets, settings) as background_tail:
            robot = ("simulate", "--seed", str(run.house.seed), "--run", "a", *connect)
            paced = ("--speed", str(speed), "--wait", str(_WAIT_S))
            children.start("simulate", (*robot, *paced), folder / "simulate.txt")
            children.wait(observe=lambda: background_tail.reached)
            followed = background_tail.wait_for(Offset(before + count))
    seconds = time.monotonic() - started
    info = log_info(log)
    with LogReader(log) as reader:
        payloads = [event.payload for event in reader.read() if event.is_envelope]
    recorded = RecordedRun(
        run_id=run.run_id,
        published=count,
        recorded=len(payloads),
        intact=payloads == list(run.payloads),
        rejected=info.rejected,
        lost=info.lost,
        drive_seconds=run.true_poses[-1].time_s,
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

    def __enter__(self) -> Self:
        rebuild(self._log, self._targets, self._settings, until=FIRST_OFFSET)
        self._running: Future[TailReport] = self._pool.submit(
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

        def done() -> bool:
            if self._running.done():
                self._running.result()  # raises the tail's error
            return self.reached >= end

        def complaint() -> str:
            return (
                f"{self._log}: the databases are at event {self.reached} of {end}, without "
                f"progress for {STALLED_S:g} s; run `{advised('status', self._log)}`"
            )

        wait_until(done, lambda: self.reached, complaint)
        self._stop.set()
        report, delays = self._running.result(), self._delays()
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
