"""Get batches of messages from the queue and check them, under load one batch ahead of the writer.

Most of the time that a message takes is spent on its validation and its SHA-256. When a whole batch
more waits in the queue, a second thread checks it while the writer thread writes the one before and
waits for the disk. Nothing is written or acknowledged here, and the writer thread appends the
batches in the order in which the messages came.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, NamedTuple

from eventsrc.append import check_payloads, rejected_event
from eventsrc.envelope import ENVELOPE_VERSION, KeyframeId, RunId
from eventsrc.ingest import Rejected
from eventsrc.log import LogWriter, NewEvent
from eventsrc.robot.acks import SENT_SUFFIX, Refusal, payload_sha256
from eventsrc.transport.session import Received

from .edit_requests import EditRequest
from .queue import MessageQueue

_CHECKED_TOGETHER: Final = 16
"""Messages checked at a time: enough to save time, few enough to fit the processor's cache."""
_CHECKED_TOGETHER_BYTES: Final = 1024 * 1024
"""Fewer are checked at a time from this size on, since all that is decoded is held at once."""


class CheckedMessage(NamedTuple):
    """A message, and what the writer thread needs of the envelope in it.

    ``run_id``, ``keyframe_id`` and ``stamp_ns`` are None for a rejected payload and for a form
    older than the envelope. ``refusal`` is the reply to a rejected payload; ``sha256`` is that of
    an envelope's payload, otherwise empty.
    """

    key: str
    payload: bytes
    version: int
    refusal: Refusal | None
    run_id: RunId | None = None
    keyframe_id: KeyframeId | None = None
    stamp_ns: int | None = None
    sha256: str = ""

    def event(self, logged_ns: int) -> NewEvent:
        """The event to append."""
        key, payload, version, refusal, _, _, stamp_ns, _ = self
        if refusal is not None:
            return rejected_event(key, payload, refusal.reason, logged_ns)
        return NewEvent(
            key, payload, logged_ns, logged_ns if stamp_ns is None else stamp_ns, version
        )


class Batch(NamedTuple):
    """What came together. ``last`` if the queue was closed and empty, so that no other follows."""

    messages: list[CheckedMessage]
    announcements: list[Received]
    edits: list[EditRequest]
    last: bool = False


class Checker:
    """Gets batches from a queue and checks them; belongs to the writer thread."""

    def __init__(self, queue: MessageQueue, writer: LogWriter, max_payload_bytes: int) -> None:
        self._queue = queue
        self._writer = writer
        self._max_payload_bytes = max_payload_bytes
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="log-checker")
        self._ahead: Future[Batch] | None = None

    def take(self, limit: int, timeout_s: float) -> Batch:
        """The batch that `begin_ahead` began; else up to ``limit`` messages, waiting for the first
        for ``timeout_s`` at most."""
        if self._ahead is None:
            return self._get(limit, timeout_s)
        batch = self._ahead.result()
        self._ahead = None
        return batch

    def begin_ahead(self, limit: int) -> None:
        """Check the next batch, of up to ``limit`` messages, in the second thread if so many wait.

        Smaller ones are left to `take`: they would cost more for being handed over than they save.
        """
        if self._queue.depth() >= limit:
            self._ahead = self._thread.submit(self._get, limit, 0.0)

    def close(self) -> int:
        """End the thread; how many messages it has taken from the queue that nobody will append."""
        self._thread.shutdown()
        if self._ahead is None or self._ahead.exception() is not None:  # which `take` has raised
            return 0
        return len(self._ahead.result().messages)

    def _get(self, limit: int, timeout_s: float) -> Batch:
        closed = self._queue.closed  # read first: what was put before closing is still recorded
        received = self._queue.get(limit, timeout_s)
        payloads: list[Received] = []
        batch = Batch([], [], [], last=closed and not received)
        for message in received:
            if isinstance(message, EditRequest):
                batch.edits.append(message)
            elif message.key.endswith(SENT_SUFFIX):
                batch.announcements.append(message)
            else:
                payloads.append(message)
        for part in _parts(payloads):
            batch.messages.extend(self.check(part))
        return batch

    def check(self, messages: Sequence[Received]) -> Iterator[CheckedMessage]:
        """Check messages together."""
        checked = check_payloads(
            [(key, payload) for key, payload, _ in messages],
            first=self._writer.next_offset,
            logged_ns=self._writer.now_ns(),
            max_bytes=self._max_payload_bytes,
        )
        for (key, payload, _), (version, result) in zip(messages, checked, strict=True):
            if isinstance(result, Rejected):
                refusal = Refusal.of(payload, result.reason)
                yield CheckedMessage(key, payload, version, refusal)
            elif version != ENVELOPE_VERSION:
                yield CheckedMessage(key, payload, version, None)
            else:
                run_id, keyframe_id = result.run_id, result.keyframe_id
                sha256, stamp = payload_sha256(payload), result.stamp_ns
                yield CheckedMessage(
                    key, payload, version, None, run_id, keyframe_id, stamp, sha256
                )


def _parts(messages: Sequence[Received]) -> Iterator[list[Received]]:
    """``messages`` in parts to be checked together."""
    part: list[Received] = []
    size = 0
    for message in messages:
        part.append(message)
        size += len(message.payload)
        if len(part) == _CHECKED_TOGETHER or size >= _CHECKED_TOGETHER_BYTES:
            yield part
            part, size = [], 0
    if part:
        yield part
