"""Record run A: one process publishes it, another records, over a router in this process.

Meanwhile a tail in a thread of this process writes the log into the databases.
"""

import statistics
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from eventsrc.advised import advised
from eventsrc.envelope import FIRST_OFFSET, Offset, RunId
from eventsrc.errors import MapfoldError
from eventsrc.log import LogReader
from eventsrc.log_info import log_info
from eventsrc.sim import SimulatedRun
from eventsrc.transport.session import Router, ZenohOptions
from projections.database import TailReport, rebuild, tail
from projections.database.connection import Targets
from projections.settings import Settings

from .children import Children
from .folder import DemoFolder
from .progress import STALLED_S, Progress, size_of

_ANY_PORT: Final = ZenohOptions(listen=("tcp/127.0.0.1:0",))
_WAIT_S: Final = 600
"""How long the publisher waits for the recorder, which is there; it makes progress meanwhile."""
_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class Recorded:
    """What the recorder received of what was published.

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
    """Have run A published, recorded into the folder's log behind what is in it, and tailed into
    the databases."""
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
        """The offset before which all is in the databases."""
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
