"""Record what is published over Zenoh: Zenoh's channel → bounded queue → one writer thread."""

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Final

from eventsrc.base.errors import TransportError
from eventsrc.envelope.crops import CROPS_TOPIC
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.ingest import DEFAULT_MAX_PAYLOAD_BYTES
from eventsrc.envelope.model import RunId
from eventsrc.log import LogWriter
from eventsrc.record.robot.acks import ACK_PREFIX, MAX_SENT_BYTES, sent_key
from eventsrc.record.transport.session import Query, Received, Session, SizeLimit, check_keys

from .bridged import Bridge
from .checking import CheckedMessage
from .edits import EditRequest, Edits, edit_key
from .listener import fetch_kept, subscribe_to
from .queue import DEFAULT_QUEUE_SIZE, BridgedMessage, CropMessage, MessageQueue
from .writer_thread import RecorderReport, WriterThread

DEFAULT_KEYS: Final = ("tb/detections",)
DEFAULT_CROPS: Final = (f"{CROPS_TOPIC}/*",)


class Recorder:
    """Records everything under ``keys`` from an open session into an open log.

    It is subscribed when the constructor returns. ``ledger`` is the log's gap history
    (`eventsrc.record.gap_history`); without it, a gap between an earlier recorder's last keyframe
    and this one's first is not found, and no ledger is saved. Turn ``report_gaps`` off for robots
    that do not count their keyframes by one. With ``edits`` it records commands too (`edits`), with
    ``bridge`` the messages of a bridge from ROS (`bridged`). Under ``crops``, each ``PREFIX/*``, it
    records the JPEGs of detections (`eventsrc.envelope.crops`), and ignores them under ``keys``.
    What ``dropper`` leaves out is not stored.
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
        edits: Edits | None = None,
        bridge: Bridge | None = None,
        crops: Sequence[str] = (),
        dropper: ClassDropper[CheckedMessage] | None = None,
    ) -> None:
        bridged = () if bridge is None else bridge.keys
        check_keys((*keys, *bridged))
        check_keys(crops)
        self._session = session
        self._bridge = bridge
        self._crop_prefixes = tuple(key.removesuffix("*") for key in crops)
        self._queue = MessageQueue(queue_size)
        self._writer_thread = WriterThread(
            self._queue,
            writer,
            ledger,
            self._send_reply,
            max_events=max_events,
            report_gaps=report_gaps,
            max_payload_bytes=max_payload_bytes,
            edits=edits,
            bridge=bridge,
            dropper=dropper,
        )
        # A larger announcement is ignored, as is one that cannot be read: it is no event.
        sent_limit = SizeLimit(MAX_SENT_BYTES, lambda: None)
        self._subscriptions = [
            subscription
            for key in keys
            for subscription in (
                session.subscribe_batches(key, self._receive),
                session.subscribe(sent_key(key), self._queue.put, limit=sent_limit),
                session.subscribe_heartbeats(key, self._queue.put_heartbeat),
            )
        ]
        self._subscriptions += [
            session.subscribe_batches(key, self._receive_crops) for key in crops
        ]
        if edits is not None:
            key = edit_key(writer.log_id)
            self._subscriptions.append(session.queryable(key, self._receive_edit))
        if bridge is not None:
            self._subscribe_bridge(session, bridge)
        session.confirm()

    def _subscribe_bridge(self, session: Session, bridge: Bridge) -> None:
        """Subscribe to the messages of a bridge, and get those kept for late subscribers."""
        self._subscriptions += subscribe_to(session, bridge, self._receive_bridged)
        self._subscriptions += [
            session.subscribe_heartbeats(key, self._queue.put_heartbeat) for key in bridge.keys
        ]
        session.confirm()
        bridge.take_new_latched()
        fetch_kept(session, bridge, bridge.latched_topics, self._receive_bridged)

    def run(
        self,
        stop: threading.Event,
        *,
        every_s: float = 1.0,
        watch: Callable[[RecorderReport], None] | None = None,
    ) -> RecorderReport:
        """Record until ``stop`` is set, then what the router has by then, and sync.

        ``watch`` is called in this thread about every ``every_s`` seconds. ``stop`` is also set
        when ``max_events`` is reached or the log cannot be written; the latter raises LogError, and
        `report` counts what was lost.
        """
        with ThreadPoolExecutor(1, thread_name_prefix="log-writer") as thread:
            writing = thread.submit(self._writer_thread.run)
            writing.add_done_callback(lambda _: stop.set())
            try:
                self._wait(stop, every_s, watch)
            finally:
                self._drain(writing)
        return self._writer_thread.report()

    def report(self) -> RecorderReport:
        """The numbers so far; may be called from any thread."""
        return self._writer_thread.report()

    def _wait(
        self,
        stop: threading.Event,
        every_s: float,
        watch: Callable[[RecorderReport], None] | None,
    ) -> None:
        bridge = self._bridge
        while not stop.wait(every_s if watch is not None or bridge is not None else None):
            if bridge is not None and (late := bridge.take_new_latched()):
                fetch_kept(self._session, bridge, late, self._receive_bridged)
            if watch is not None:
                watch(self.report())

    def _drain(self, writing: "Future[None]") -> None:
        if not writing.done():
            with suppress(TransportError):
                self._session.confirm()  # its reply comes behind what the router sends us
        for subscription in self._subscriptions:
            subscription.close()
        self._queue.close()
        writing.result()

    def _receive(self, messages: Sequence[Received]) -> None:
        # A recorder of `**` also receives acks and refusals, which are not data, and each crop a
        # second time.
        ignored = (ACK_PREFIX, *self._crop_prefixes)
        self._queue.put_all([m for m in messages if not m.key.startswith(ignored)])

    def _receive_bridged(self, message: Received) -> None:
        self._queue.put(BridgedMessage(message.key, message.payload, message.number))

    def _receive_crops(self, messages: Sequence[Received]) -> None:
        self._queue.put_all([CropMessage(m.key, m.payload, m.number) for m in messages])

    def _receive_edit(self, query: Query) -> None:
        request = EditRequest(query)
        if request.fault is not None:
            request.refuse(request.fault)
        elif not self._queue.put_edit(request):
            request.refuse("the recorder is busy or ending; try again in a moment")

    def _send_reply(self, key: str, payload: bytes) -> None:
        try:
            self._session.send(key, payload)
        except TransportError:
            # The robot sends the message again, and is then replied to again.
            return
