"""Get batches of messages from the queue and check them, also while the writer waits for the disk.

Most of the time that a message takes is spent on its validation and its SHA-256. Both are done
ahead, a few messages at a time, while a commit waits for the disk (`LogWriter.work_while_syncing`).
Nothing is appended or acknowledged meanwhile, and messages are appended in the order in which they
came.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import msgspec

from eventsrc.envelope.crops import InvalidCrop, encode_crop, received_crop
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.ingest import DEFAULT_MAX_PAYLOAD_BYTES, Rejected
from eventsrc.envelope.model import ENVELOPE_VERSION, KeyframeId, RunId, has_keyframe_id
from eventsrc.envelope.system_events import MAP_KEY, Excerpt
from eventsrc.log import LogWriter, MessageFormat, NewEvent
from eventsrc.record.append import (
    CROP_FORMAT,
    NewMap,
    check_payloads,
    map_event,
    rejected_event,
    without_dropped,
)
from eventsrc.record.robot.acks import SENT_SUFFIX, Refusal, payload_sha256
from eventsrc.record.transport.session import Received

from .edits import EditRequest
from .queue import MAX_BATCH_BYTES, BridgedMessage, CropMessage, MessageQueue

_BATCH: Final = 256
_CHECKED_TOGETHER: Final = 16
"""Messages checked at a time: enough to save time, few enough to fit the processor's cache."""
_CHECKED_TOGETHER_BYTES: Final = 1024 * 1024
"""Fewer are checked at a time from this size on, since all that is decoded is held at once."""


_MAX_KEPT: Final = 2
"""A rejected message of up to this many times the size limit (or the default limit, if larger) is
kept whole. Of a larger one only an excerpt is, because it would be in memory several times."""


class CheckedMessage(msgspec.Struct, frozen=True, gc=False):
    """A checked message, and what the writer thread needs of the envelope in it. The payload of a
    map is already that of its event; its key is `MAP_KEY`, which no other accepted message has.

    ``run_id``, ``keyframe_id`` and ``stamp_ns`` are None for a rejected payload and for a form
    older than the envelope. ``refusal`` is the reply to a rejected payload; ``sha256`` is that of
    an envelope's payload, otherwise empty. ``form`` is the format of a crop, or of a message of a
    bridge, which are kept verbatim. ``excerpt`` is kept in place of a payload that is
    too large.
    """

    key: str
    payload: bytes
    version: int
    refusal: Refusal | None
    run_id: RunId | None = None
    keyframe_id: KeyframeId | None = None
    stamp_ns: int | None = None
    sha256: str = ""
    form: MessageFormat | None = None
    excerpt: Excerpt | None = None

    def event(self, logged_ns: int) -> NewEvent:
        """The event to append."""
        if self.refusal is not None:
            kept = self.excerpt or self.payload
            return rejected_event(self.key, kept, self.refusal.reason, logged_ns)
        if self.key == MAP_KEY:
            return map_event(self.payload, logged_ns)
        stamp_ns = logged_ns if self.stamp_ns is None else self.stamp_ns
        return NewEvent(self.key, self.payload, logged_ns, stamp_ns, self.version, self.form)


class Batch:
    """Messages, announcements and commands that are appended together."""

    def __init__(self) -> None:
        self.messages: list[CheckedMessage] = []
        self.bridged: list[BridgedMessage] = []
        self.announcements: list[Received] = []
        self.edits: list[EditRequest] = []
        self.size = 0
        """Payload bytes of the messages."""

    @property
    def empty(self) -> bool:
        """Whether nothing is in it."""
        return not (self.messages or self.bridged or self.announcements or self.edits)

    @property
    def count(self) -> int:
        """Messages in it."""
        return len(self.messages) + len(self.bridged)


class Checker:
    """Gets batches from a queue and checks them, ``max_messages`` in all; belongs to the writer
    thread."""

    def __init__(
        self,
        queue: MessageQueue,
        writer: LogWriter,
        *,
        max_payload_bytes: int,
        max_messages: int | None,
        dropper: ClassDropper[CheckedMessage] | None = None,
    ) -> None:
        self._queue = queue
        self.dropper = ClassDropper[CheckedMessage]() if dropper is None else dropper
        self._writer = writer
        self._max_payload_bytes = max_payload_bytes
        self._max_kept_bytes = _MAX_KEPT * max(max_payload_bytes, DEFAULT_MAX_PAYLOAD_BYTES)
        self._left = max_messages
        self._ahead = Batch()

    @property
    def waiting(self) -> int:
        """Messages from the queue that are checked and in no batch yet."""
        return self._ahead.count

    def next_batch(self, timeout_s: float) -> Batch | None:
        """The next batch; an empty one if nothing came in time, None after the last one."""
        closed = self._queue.closed  # read first: messages put before closing are recorded
        self._add(_BATCH, timeout_s if self._ahead.empty else 0.0)
        batch, self._ahead = self._ahead, Batch()
        return None if batch.empty and (closed or self._left == 0) else batch

    def check_ahead(self) -> bool:
        """Check a few messages for the next batch; False if none wait or the batch is full."""
        return self._add(_CHECKED_TOGETHER, 0.0)

    def _add(self, limit: int, timeout_s: float) -> bool:
        """Add up to ``limit`` messages from the queue; False if there is none or no room."""
        batch = self._ahead
        limit = min(limit, _BATCH - batch.count)
        if self._left is not None:
            limit = min(limit, self._left)
        if limit == 0 or batch.size >= MAX_BATCH_BYTES:
            return False
        received = self._queue.get(limit, timeout_s)
        payloads: list[Received] = []
        before = batch.count
        for message in received:
            if isinstance(message, EditRequest):
                batch.edits.append(message)
            elif len(message.payload) > self._max_kept_bytes:
                batch.messages.append(self._excerpt(message))
                batch.size += len(message.payload)
            elif isinstance(message, BridgedMessage):
                batch.bridged.append(message)
                batch.size += len(message.payload)
            elif isinstance(message, CropMessage):
                batch.messages += self._crop(message)
                batch.size += len(message.payload)
            elif message.key.endswith(SENT_SUFFIX):
                batch.announcements.append(message)
            else:
                payloads.append(message)
                batch.size += len(message.payload)
        for part in _split(payloads):
            batch.messages.extend(self.check(part))
        if self._left is not None:
            self._left -= batch.count - before
        return bool(received)

    def _excerpt(self, message: Received) -> CheckedMessage:
        """The rejection of a message of which only an excerpt is kept."""
        excerpt = Excerpt.of((message.payload,))
        reason = excerpt.reason(self._max_kept_bytes)
        if self.dropper:
            return self._refused(message, reason)
        refusal = Refusal(sha256=excerpt.sha256, size=excerpt.size, reason=reason)
        return CheckedMessage(message.key, b"", ENVELOPE_VERSION, refusal, excerpt=excerpt)

    def _refused(
        self, message: Received, reason: str, version: int = ENVELOPE_VERSION
    ) -> CheckedMessage:
        refusal = Refusal.of(message.payload, self.dropper.reason(reason))
        kept = self.dropper.kept_of(message.payload)
        if isinstance(kept, Excerpt):
            return CheckedMessage(message.key, b"", version, refusal, excerpt=kept)
        return CheckedMessage(message.key, kept, version, refusal)

    def _crop(self, message: CropMessage) -> list[CheckedMessage]:
        """The crop to append, or its rejection; none while its detection may be dropped."""
        try:
            topic, crop = received_crop(message.key, message.payload)
        except InvalidCrop as error:
            return [self._refused(message, str(error))]
        kept = encode_crop(crop, self._writer.now_ns())
        checked = CheckedMessage(topic, kept, ENVELOPE_VERSION, None, form=CROP_FORMAT)
        return self.dropper.crop(crop.det_id, checked, len(kept))

    def check(self, messages: Sequence[Received]) -> Iterator[CheckedMessage]:
        """Validate messages together; the result of each, in order, behind an envelope the crops
        that waited for it."""
        checked = check_payloads(
            [(message.key, message.payload) for message in messages],
            first=self._writer.next_offset,
            logged_ns=self._writer.now_ns(),
            max_bytes=self._max_payload_bytes,
        )
        for message, whole in zip(messages, checked, strict=True):
            known, stripped = without_dropped(message.payload, whole, self.dropper)
            key, payload = message.key, stripped.payload
            version, result = known.version, known.result
            if isinstance(result, Rejected):
                yield self._refused(message, result.reason, version)
            elif isinstance(result, NewMap):
                yield CheckedMessage(MAP_KEY, result.event, version, None)
            elif not has_keyframe_id(version):
                yield CheckedMessage(key, payload, version, None)
            else:
                run_id, keyframe_id = result.run_id, result.keyframe_id
                # of what the robot sent, which it waits for
                sha256, stamp = payload_sha256(message.payload), result.stamp_ns
                yield CheckedMessage(
                    key, payload, version, None, run_id, keyframe_id, stamp, sha256
                )
            yield from self.dropper.release(stripped)


def _split(messages: Sequence[Received]) -> Iterator[list[Received]]:
    """Split ``messages`` into parts that are checked together."""
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
