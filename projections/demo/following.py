"""The databases follow the log while it is recorded; later a replay must give the same rows."""

import statistics
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from psycopg import sql

from eventsrc.errors import MapfoldError
from eventsrc.log import LogReader
from projections.postgres.connect import Targets, connect, database_errors
from projections.runner import TailReport, rebuild, tail
from projections.settings import Settings
from projections.sinks.labels import GRAPH, LABELS, TABLE

_PATIENCE_S: Final = 30.0
_STEP_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class Followed:
    """How the databases kept up: delays from an event's recording to its being readable there."""

    events: int
    batches: int
    median_delay_s: float
    worst_delay_s: float


class Follower:
    """A tail beside the recorder, in a thread of this process, for the length of a ``with`` block.

    It begins from an empty projection of this log, whatever the databases held before.
    """

    def __init__(self, log: Path, targets: Targets, settings: Settings) -> None:
        self._log, self._targets, self._settings = log, targets, settings
        self._stop = threading.Event()
        self._commits: list[tuple[int, int]] = []
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tail")
        self._running: Future[TailReport] | None = None

    def __enter__(self) -> Self:
        rebuild(self._log, self._targets, self._settings, until=0)
        self._running = self._pool.submit(
            tail, self._log, self._targets, self._settings, stop=self._stop, on_batch=self._note
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown()

    def caught_up(self, end: int) -> Followed:
        """Wait until ``end`` events are in the databases; tells how they kept up."""
        assert self._running is not None  # noqa: S101 - inside the with block
        deadline, pause = time.monotonic() + _PATIENCE_S, threading.Event()
        while not self._commits or self._commits[-1][0] < end:
            if self._running.done():
                self._running.result()  # raises what ended it
            if time.monotonic() > deadline:
                raise MapfoldError(
                    f"{self._log}: the databases did not reach event {end} within "
                    f"{_PATIENCE_S:g} s; run mapfold status {self._log}"
                )
            pause.wait(_STEP_S)
        self._stop.set()
        report = self._running.result(_PATIENCE_S)
        delays = self._delays()
        return Followed(report.events, report.batches, statistics.median(delays), max(delays))

    def _note(self, report: TailReport) -> None:
        self._commits.append((report.next_offset, time.time_ns()))

    def _delays(self) -> list[float]:
        """Seconds for every event, from the log's time stamp to the commit that covers it."""
        delays: list[float] = []
        commits = iter(self._commits)
        reached, committed_ns = 0, 0
        with LogReader(self._log) as reader:
            for event in reader.read(0, self._commits[-1][0]):
                while reached <= event.offset:
                    reached, committed_ns = next(commits)
                delays.append((committed_ns - event.logged_ns) / 1e9)
        return delays


def fingerprint(targets: Targets) -> dict[str, str]:
    """For every table of graph and vectors a hash over all its rows, whatever their order.

    ``ingested_at`` is left out: it says when a row was written, not what is in it.
    """
    tables = [(targets.graph_url, sql.Identifier(GRAPH, label)) for label in LABELS]
    tables.append((targets.vector_url, sql.Identifier("public", TABLE)))
    hashes: dict[str, str] = {}
    for url, table in tables:
        with database_errors(url), connect(url, application="mapfold demo") as connection:
            row = connection.execute(
                sql.SQL(
                    "SELECT count(*), md5(string_agg(line, '|' ORDER BY line)) FROM"
                    " (SELECT (to_jsonb(t.*) - 'ingested_at')::text AS line FROM {} AS t) AS lines"
                ).format(table)
            ).fetchone()
        hashes[table.as_string()] = repr(row)
    return hashes
