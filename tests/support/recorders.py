"""A recorder at work beside a test."""

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from eventsrc.envelope.gaps import DEFAULT_SETTLE_NS
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.recorder import Recorder, RecorderReport
from eventsrc.record.transport.session import Session
from tests.support.fixtures_log import KEY
from tests.support.fixtures_zenoh import DEADLINE_S


class Running:
    """A recorder at work in this process; `finish` stops it and returns its report."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._seen = threading.Condition()
        self._latest = recorder.report()
        self._stop = threading.Event()
        self._thread = ThreadPoolExecutor(1)
        self._done = self._thread.submit(recorder.run, self._stop, every_s=0.01, watch=self._watch)

    def _watch(self, report: RecorderReport) -> None:
        with self._seen:
            self._latest = report
            self._seen.notify_all()

    def wait_until(self, true: Callable[[RecorderReport], bool]) -> None:
        with self._seen:
            assert self._seen.wait_for(lambda: true(self._latest), DEADLINE_S), self._latest

    def finish(self) -> RecorderReport:
        self._stop.set()
        self._thread.shutdown()
        return self._done.result()


@contextmanager
def recording(
    session: Session,
    log: Path,
    keys: Sequence[str] = (KEY,),
    queue_size: int = 1_000,
    settle_ns: int = DEFAULT_SETTLE_NS,
) -> Iterator[Running]:
    """Record in a ``with`` block."""
    with LogWriter(log) as writer:
        with LogReader(log) as reader:
            ledger = ledger_of(reader, settle_ns=settle_ns)
        running = Running(Recorder(session, writer, keys, queue_size=queue_size, ledger=ledger))
        try:
            yield running
        finally:
            running._stop.set()
            running._thread.shutdown()
