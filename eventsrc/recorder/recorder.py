"""Zenoh to log: callback → bounded queue → one writer thread."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final

from eventsrc.envelope import RunId
from eventsrc.errors import TransportError
from eventsrc.gaps import GapLedger
from eventsrc.ingest import DEFAULT_MAX_PAYLOAD_BYTES
from eventsrc.log import LogWriter
from eventsrc.robot.acks import ACK_PREFIX, MAX_SENT_BYTES, sent_key
from eventsrc.transport.session import Received, SequenceNumber, Session, SizeLimit, check_keys

from .queue import DEFAULT_QUEUE_SIZE, Inbox
from .writer_thread import RecorderReport, Writing

DEFAULT_KEYS: Final = ("tb/detections",)
_REJECTED_WHOLE: Final = 2
"""A message of up to so many times the size limit, or the default limit if that is larger, is
rejected and kept, and its robot is told, so that it stops sending it. A larger one is a loss: it
would be in memory several times over before it is on the disk."""


class Recorder:
    """Records everything under ``keys`` from an open session into an open log.

    Subscribed when the constructor returns: from then on nothing published passes it by. ``ledger``
    is what the log already holds (see `eventsrc.gap_history`); without it, a gap between an earlier
    recorder's last keyframe and this one's first is not seen, and no ledger is saved.
    ``report_gaps`` off is for robots that do not count their keyframes by one.
    """

    def __init__(
        self,
        session: Session,
        writer: LogWriter,
        keys: Sequence[str] = DEFAULT_KEYS,
        *,
        queue_size: int = DEFAULT_QUEUE_SIZE,
        max_events: int | None = None,
        ledger: GapLedger[RunId] | None = None,
        report_gaps: bool = True,
        max_payload_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
    ) -> None:
        check_keys(keys)
        self._session = session
        self._inbox = Inbox(queue_size)
        self._writing = Writing(
            self._inbox,
            writer,
            ledger,
            self._answer,
            max_events=max_events,
            report_gaps=report_gaps,
            max_payload_bytes=max_payload_bytes,
        )
        limit = SizeLimit(
            _REJECTED_WHOLE * max(max_payload_bytes, DEFAULT_MAX_PAYLOAD_BYTES), self._refuse
        )
        # A longer one says nothing, like any that cannot be read: no event is lost with it.
        sent_limit = SizeLimit(MAX_SENT_BYTES, lambda _key, _number: None)
        self._subscriptions = [
            subscription
            for key in keys
            for subscription in (
                session.subscribe(key, self._receive, limit=limit),
                session.subscribe(sent_key(key), self._inbox.put, limit=sent_limit),
                session.subscribe_heartbeats(key, self._inbox.told),
            )
        ]
        session.confirm()

    def run(
        self,
        stop: threading.Event,
        *,
        every_s: float = 1.0,
        watch: Callable[[RecorderReport], None] | None = None,
    ) -> RecorderReport:
        """Record until ``stop`` is set, then drain the queue and sync.

        ``watch`` is called in this thread about every ``every_s`` seconds. Raises what ended the
        writing early, a LogError, and `report` then says what was lost with it; ``stop`` is set
        then too, and when ``max_events`` is reached.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="log-writer") as thread:
            writing = thread.submit(self._writing.run)
            writing.add_done_callback(lambda _: stop.set())
            try:
                self._wait(stop, every_s, watch)
            finally:
                self._drain(writing)
        return self._writing.report()

    def report(self) -> RecorderReport:
        """The numbers so far; may be asked for from any thread."""
        return self._writing.report()

    def _wait(
        self,
        stop: threading.Event,
        every_s: float,
        watch: Callable[[RecorderReport], None] | None,
    ) -> None:
        while not stop.wait(every_s if watch is not None else None):
            if watch is not None:
                watch(self.report())

    def _drain(self, writing: "Future[None]") -> None:
        for subscription in self._subscriptions:
            subscription.close()
        self._inbox.close()
        writing.result()

    def _receive(self, message: Received) -> None:
        # Under `**` a recorder hears acks and refusals, its own too. They are answers, not data.
        if not message.key.startswith(ACK_PREFIX):
            self._inbox.put(message)

    def _refuse(self, key: str, number: SequenceNumber | None) -> None:
        if not key.startswith(ACK_PREFIX):
            self._inbox.refuse(key, number)

    def _answer(self, key: str, payload: bytes) -> None:
        try:
            self._session.send(key, payload)
        except TransportError:
            # No way to tell the robot now. It will send again, and be answered again.
            return
