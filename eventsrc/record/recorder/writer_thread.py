"""The recorder's writer thread: append messages of the queue, acknowledge them once synced.

* This thread alone appends to the log and commits. It gets checked batches from the queue
  (`checking`), and has the next messages checked while it waits for the disk.
* Only when an event is synced does it enter the gap ledger, count as recorded, and get an
  acknowledgement or a refusal.
* An acknowledgement names the payloads of one sync only. What an earlier recorder synced may have
  been damaged since, whatever a saved ledger says; a robot that still has it sends it again.
* A robot's announcement of its last keyframe comes through the same queue, behind the messages
  before it, and enters the gap ledger when those are synced. It is not recorded.
* When a segment file is deleted, cut short or replaced, the log goes on in a new one. Events synced
  in the old one are then not acknowledged any more, and no ledger is saved, because it would
  contain events that the log has lost.
* When the log cannot be written any more, everything received and not known to be synced is counted
  as unwritten: in the commit group, in the batch at hand and the next, or in the queue.
* Losses are recorded about once a second, not one by one, to spare an overloaded recorder.
* `check_payloads` rejects messages under ``mapfold/``: they could forge a loss or a command.
* A message of a bridge (`bridged`) is appended with what it completes right behind it.
* A command that came as a query (`edits`) is appended behind the messages of its batch and
  synced at once. It is not counted as a message.
"""

import itertools
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, cast

from pydantic import ValidationError

from eventsrc.base.errors import LogError
from eventsrc.envelope.dropped_classes import NO_DROPPED, ClassDropper, Dropped
from eventsrc.envelope.gaps import Gap, GapLedger, Source
from eventsrc.envelope.model import Offset, RunId
from eventsrc.envelope.system_events import LOSS_KEY, ROS_KEY, Loss
from eventsrc.log import LogWriter
from eventsrc.record.append import CROP_FORMAT
from eventsrc.record.gap_history import delete_ledger, save_ledger
from eventsrc.record.robot import acks
from eventsrc.record.transport.session import Received
from eventsrc.ros.derivation import RosRecording
from eventsrc.ros.stream import Counts

from .bridged import Bridge
from .checking import Batch, CheckedMessage, Checker
from .edits import EditRequest, Edits
from .queue import MessageQueue


class Replies:
    """Acknowledgements and refusals for the events of one sync."""

    def __init__(self) -> None:
        self._synced: defaultdict[tuple[RunId, str], list[str]] = defaultdict(list)
        self._refusals: defaultdict[str, list[acks.Refusal]] = defaultdict(list)

    def add(self, event: CheckedMessage) -> None:
        """Add a message whose event is synced."""
        if event.run_id is not None and event.sha256:
            self._synced[event.run_id, event.key].append(event.sha256)
        if event.refusal is not None:
            self._refusals[event.key].append(event.refusal)

    def messages(self, log_id: str) -> Iterator[tuple[str, bytes]]:
        """Key and payload of each reply."""
        for (run_id, key), digests in self._synced.items():
            for start in range(0, len(digests), acks.MAX_PER_ACK):
                some = tuple(digests[start : start + acks.MAX_PER_ACK])
                ack = acks.Ack(run_id=run_id, key=key, log_id=log_id, sha256=some)
                yield acks.ack_key(run_id), ack.encode()
        for key, refused in self._refusals.items():
            yield (
                acks.refusal_key(key),
                acks.Refusals(log_id=log_id, refused=tuple(refused)).encode(),
            )


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """Numbers of a recorder, counted from its start.

    ``recorded`` envelopes are synced, ``rejected`` payloads are kept under ``mapfold/rejected``.
    ``queue_full`` and ``transport_missed`` messages were sent and are not in the
    log. ``missing`` keyframes are those that the log's runs lack now, whichever recorder lost them;
    ``missing_before`` is that number at the start. A message lost in the queue is usually also a
    missing keyframe. ``unwritten`` messages were received when the log could not be written any
    more; the next start may find some of them on the disk. ``unsealed`` segments are finished and
    not sealed, with ``sealing_error`` if sealing fails: they take more disk, nothing is lost.
    ``faults`` describe segment files that were deleted, cut short or written to by others, and
    ``lost_from_log`` counts the recorded events in them. ``commands`` of `mapfold edit`, and
    ``crops``, are synced; ``dropped`` was left out since the log never stores its class.
    """

    recorded: int
    rejected: int
    queue_full: int
    transport_missed: int
    missing: int
    missing_before: int
    queue_depth: int
    queue_size: int
    next_offset: Offset
    unwritten: int = 0
    unsealed: int = 0
    sealing_error: str | None = None
    lost_from_log: int = 0
    faults: tuple[str, ...] = ()
    commands: int = 0
    crops: int = 0
    messages: int = 0
    """Messages of a bridge that are kept verbatim and synced."""
    held: int = 0
    """Messages of a bridge that wait for their type."""
    untyped: int = 0
    """Messages of a bridge that are kept without a schema: their type is not known."""
    unread: tuple[tuple[str, int, str], ...] = ()
    """Topics whose messages are kept but cannot be read, how many, and why the first cannot."""
    unknown_keys: int = 0
    """Messages of a bridge left out, since their keys belong to no recorded topic."""
    streams: tuple[tuple[str, Counts], ...] = ()
    """Counts of the envelopes made, by topic of detections of a bridge."""
    dropped: Dropped = NO_DROPPED

    @property
    def lost(self) -> int:
        """Messages that were sent and are not, or no longer, in the log."""
        never_appended = self.queue_full + self.transport_missed
        return never_appended + self.unwritten + self.lost_from_log

    @property
    def clean(self) -> bool:
        """True when this recorder lost nothing, rejected nothing, could read the messages of a
        bridge, and left no new gap."""
        unused = self.rejected or self.untyped or self.unread or self.unknown_keys
        return not (unused or self.lost or self.missing > self.missing_before)


SendReply = Callable[[str, bytes], None]
"""Sends a payload under a key."""

_IDLE_S: Final = 0.25
_COMMIT_POLL_S: Final = 0.005
"""How long to wait for messages while events are unsynced: a tenth of the default commit time."""
_LOSSES_EVERY_NS: Final = 1_000_000_000
_FIRST_SAVE_NS: Final = 1_000_000_000
_SAVE_EVERY_NS: Final = 60_000_000_000
"""The ledger is saved after one second, then after twice the time before, up to a minute: after a
kill, at most half of what was recorded, or a minute of it, must be read again."""


class _Announcement(NamedTuple):
    """A robot's last keyframe, announced when the log's next offset was ``offset``."""

    offset: Offset
    sent: acks.Sent


class WriterThread:
    """The work of the writer thread, which calls `run`."""

    def __init__(
        self,
        queue: MessageQueue,
        writer: LogWriter,
        ledger: GapLedger[RunId] | None,
        send_reply: SendReply,
        *,
        max_events: int | None,
        report_gaps: bool,
        max_payload_bytes: int,
        edits: Edits | None = None,
        bridge: Bridge | None = None,
        dropper: ClassDropper[CheckedMessage] | None = None,
    ) -> None:
        self._queue = queue
        self._bridge = bridge
        self._writer = writer
        self._edits = edits
        self._ledger: GapLedger[RunId] = GapLedger() if ledger is None else ledger
        self._saves_ledger = ledger is not None  # a new ledger does not cover the whole log
        self._send_reply = send_reply
        self._report_gaps = report_gaps
        self._losses_due_ns = time.monotonic_ns() + _LOSSES_EVERY_NS
        self._save_after_ns = _FIRST_SAVE_NS
        self._save_due_ns = time.monotonic_ns() + self._save_after_ns
        self._checker = Checker(
            queue,
            writer,
            max_payload_bytes=max_payload_bytes,
            max_messages=max_events,
            dropper=dropper,
        )
        self._unsynced: deque[tuple[Offset, CheckedMessage]] = deque()
        self._announcements: deque[_Announcement] = deque()
        self._in_progress = 0  # checked and not appended
        self._failed = False
        self._faults = 0
        self._recorded = self._rejected = self._messages = self._crops = 0
        self._missing = self._missing_before = self._ledger.missing if report_gaps else 0

    def run(self) -> None:
        """Record until the queue is closed and empty, or ``max_events`` is reached. Raises LogError
        when the log cannot be written; everything synced is safe."""
        self._writer.work_while_syncing(self._checker.check_ahead)
        try:
            if self._bridge is not None:
                self._writer.append(ROS_KEY, self._bridge.recording.encode())
            while self._step():
                pass
            self._writer.work_while_syncing(None)
            if self._bridge is not None:
                self._finish_bridge(self._bridge)
            self._sync()
            self._write_losses(self._ledger.flush(), self._queue.drain_missed(None))
            self._save()
        except LogError as error:
            self._failed = True
            self._process_synced()  # what was synced before the error
            if self._edits is not None:
                self._edits.refuse_all(str(error))
            raise
        finally:
            self._writer.work_while_syncing(None)
        self._process_synced()

    def report(self) -> RecorderReport:
        """The numbers now; may be called from any thread."""
        writer = self._writer
        sealing = writer.sealing
        return RecorderReport(
            recorded=self._recorded,
            rejected=self._rejected,
            queue_full=self._queue.overflowed,
            transport_missed=self._queue.missed,
            missing=self._missing,
            missing_before=self._missing_before,
            queue_depth=self._queue.depth(),
            queue_size=self._queue.size,
            next_offset=writer.durable_offset if self._failed else writer.next_offset,
            unwritten=self._unwritten(),
            unsealed=sealing.waiting,
            sealing_error=None if sealing.error is None else str(sealing.error),
            lost_from_log=sum(fault.lost_events for fault in writer.faults),
            faults=tuple(map(str, writer.faults)),
            commands=0 if self._edits is None else self._edits.recorded,
            crops=self._crops,
            messages=self._messages,
            held=0 if self._bridge is None else self._bridge.held,
            untyped=0 if self._bridge is None else self._bridge.untyped,
            unread=() if self._bridge is None else self._bridge.unread,
            unknown_keys=0 if self._bridge is None else self._bridge.unknown_keys,
            streams=() if self._bridge is None else self._bridge.streams,
            dropped=self._checker.dropper.counts,
        )

    def _unwritten(self) -> int:
        if not self._failed:
            return 0
        held = 0 if self._bridge is None else self._bridge.held
        checked = self._in_progress + self._checker.waiting + held
        return len(self._unsynced) + checked + self._queue.depth()

    def _step(self) -> bool:
        """Record one batch; False when there will be no more."""
        waiting = self._writer.durable_offset < self._writer.next_offset
        batch = self._checker.next_batch(_COMMIT_POLL_S if waiting else _IDLE_S)
        if batch is None:
            return False
        self.append(batch)
        self._writer.commit_if_due()
        self._process_synced()
        now_ns = time.monotonic_ns()
        if now_ns >= self._losses_due_ns:
            self._losses_due_ns = now_ns + _LOSSES_EVERY_NS
            self._write_losses(self._ledger.due(now_ns), self._queue.drain_missed(now_ns))
        if now_ns >= self._save_due_ns:
            self._save_after_ns = min(2 * self._save_after_ns, _SAVE_EVERY_NS)
            self._save_due_ns = now_ns + self._save_after_ns
            self._save()
        return True

    def append(self, batch: Batch) -> None:
        """Append a batch. May commit, also in the middle of it."""
        self._in_progress = batch.count
        logged_ns = self._writer.now_ns()
        messages = batch.messages
        if self._bridge is not None:
            messages = messages + self._bridge.take(batch.bridged, logged_ns, self._checker.check)
        self._append_messages(messages, logged_ns)
        self._hold_announcements(batch.announcements)
        if batch.edits:
            self._append_edits(batch.edits)

    def _append_messages(self, messages: list[CheckedMessage], logged_ns: int) -> None:
        events = [message.event(logged_ns) for message in messages]
        # Before appending: if that fails in the middle, what was synced by then still counts.
        first = self._writer.next_offset
        offsets = cast("Iterator[Offset]", itertools.count(first))  # no call for each event
        self._unsynced.extend(zip(offsets, messages, strict=False))
        self._in_progress = 0
        self._writer.append_all(events)

    def _finish_bridge(self, bridge: Bridge) -> None:
        logged_ns = self._writer.now_ns()
        self._append_messages(bridge.finish(logged_ns, self._checker.check), logged_ns)
        self._writer.append(ROS_KEY, RosRecording(key=bridge.recording.key).encode())

    def _append_edits(self, requests: list[EditRequest]) -> None:
        if self._edits is not None:
            for request in requests:
                self._edits.append(request)
            self._writer.sync()

    def _hold_announcements(self, announcements: list[Received]) -> None:
        """Keep announcements until everything appended so far is synced."""
        for message in announcements:
            try:
                sent = acks.Sent.decode(message.payload)
            except ValidationError:
                continue  # no announcement that this version understands
            self._announcements.append(_Announcement(self._writer.next_offset, sent))

    def _process_synced(self) -> None:
        """Count and acknowledge everything synced since the last call."""
        durable = self._writer.durable_offset
        self._discard_lost()
        now_ns = time.monotonic_ns()
        if self._unsynced and self._unsynced[0][0] < durable:
            self._acknowledge(durable, now_ns)
        if self._edits is not None:
            self._edits.reply_to_durable(durable)
        while self._announcements and self._announcements[0].offset <= durable:
            sent = self._announcements.popleft().sent
            self._ledger.expect(sent.run_id, sent.last, now_ns)

    def _acknowledge(self, durable: Offset, now_ns: int) -> None:
        """Count the events before ``durable``, enter them in the ledger and send the replies."""
        waiting, replies, ledger = self._unsynced, Replies(), self._ledger
        rejected, messages, crops, before = 0, 0, 0, len(waiting)
        while waiting and waiting[0][0] < durable:
            _, message = waiting.popleft()
            rejected += message.refusal is not None
            crops += message.form is CROP_FORMAT
            messages += message.form not in (None, CROP_FORMAT)
            run_id, keyframe_id = message.run_id, message.keyframe_id
            if run_id is not None and keyframe_id is not None:
                ledger.record(run_id, keyframe_id, now_ns)
            replies.add(message)
        self._rejected += rejected
        self._messages += messages
        self._crops += crops
        self._recorded += before - len(waiting) - rejected - messages - crops
        for key, payload in replies.messages(self._writer.log_id):
            self._send_reply(key, payload)

    def _discard_lost(self) -> None:
        """Forget events that were synced in a file which has been given up since."""
        faults = self._writer.faults
        if len(faults) == self._faults:
            return
        self._faults = len(faults)
        lost = [(fault.base, fault.following) for fault in faults if fault.lost_events]
        if not lost:
            return
        if self._edits is not None:
            self._edits.refuse_lost(lost)
        kept = [e for e in self._unsynced if not any(a <= e[0] < b for a, b in lost)]
        self._unsynced = deque(kept)
        if self._saves_ledger:
            self._saves_ledger = False
            delete_ledger(self._writer.path)

    def _sync(self) -> Offset:
        """Sync everything, so that the ledger covers the whole log; returns the log's end."""
        next_offset = self._writer.sync()
        self._process_synced()
        return next_offset

    def _save(self) -> None:
        next_offset = self._sync()
        if self._saves_ledger:
            save_ledger(self._writer.path, self._writer.log_id, next_offset, self._ledger)

    def _write_losses(self, missing: list[Gap[RunId]], missed: list[Gap[str]]) -> None:
        """Append losses: ``missing`` keyframes, ``missed`` sequence numbers, and queue losses."""
        for gap in missing if self._report_gaps else ():
            self._append_loss(_loss("keyframe_gap", gap))
        for key, count in self._queue.drain_overflow().items():
            self._append_loss(Loss(publisher=key, count=count, cause="queue_full"))
        for of_source in missed:
            self._append_loss(_loss("transport_miss", of_source))
        self._missing = self._ledger.missing if self._report_gaps else 0

    def _append_loss(self, loss: Loss) -> None:
        self._writer.append(LOSS_KEY, loss.model_dump_json().encode())


def _loss(cause: Literal["keyframe_gap", "transport_miss"], gap: Gap[Source]) -> Loss:
    return Loss(publisher=gap.run_id, first=gap.first, last=gap.last, count=gap.count, cause=cause)
