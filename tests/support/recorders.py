"""A recorder at work beside a test.

Acknowledgements as a recorder sends them, and what of a robot is in a log.
"""

import json
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from eventsrc.envelope.gaps import DEFAULT_SETTLE_NS
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.recorder.writer_thread import RecorderReport
from eventsrc.record.robot.acks import Ack, payload_sha256
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Session, ZenohOptions
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


def robot_at(endpoint: str, folder: Path) -> EnvelopePublisher:
    """A publisher that sends again soon."""
    return EnvelopePublisher(
        ZenohOptions(connect=(endpoint,)), folder / "spool", resend_after_s=0.2
    )


def encoded_ack(*payloads: bytes, key: str = KEY) -> bytes:
    """A recorder's acknowledgement of these."""
    digests = tuple(map(payload_sha256, payloads))
    return Ack(run_id="run-a", key=key, log_id="log", sha256=digests).encode()


def stored_payloads(log: Path) -> list[bytes]:
    """Envelopes in a log, each once: a robot that waits long for an acknowledgement sends again."""
    with LogReader(log) as reader:
        return list(dict.fromkeys(event.payload for event in reader.read(keys={KEY})))


def keyframe_ids(log: Path) -> set[int]:
    """Ids of the keyframes in a log."""
    return {json.loads(p)["keyframe_id"] for p in stored_payloads(log)}
