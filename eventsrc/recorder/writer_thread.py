"""The writer's thread: from the queue into the log, and what follows from it.

* One thread owns the LogWriter. It takes batches from the inbox, appends, and lets the log commit.
* Nothing follows from an event before it is synced: only then does it enter the gap ledger, count
  as recorded, and is its robot told: acknowledged, or refused.
* An ack names the payloads of one sync and nothing else. What an earlier recorder has synced may
  have rotted since, whatever a saved ledger says; a robot that still has it sends it again.
* How far a robot says it has got comes through the same queue, behind what it sent before, and
  enters the gap ledger when that is synced. It is nothing to record.
* When a segment file is taken away, cut short or replaced, the log goes on in a new one. What had
  been synced in the old one and is not answered yet never is, and no ledger is saved any more, for
  it would know events that the log has lost.
* When the log cannot be written any more, what was received and is not known to be synced is
  counted: being written, taken, or still in the queue.
* Losses are written about once a second, not one by one: a queue that overflows is busy enough.
* Keys under ``mapfold/`` are our own. From the network they could forge a loss or a command, so
  `prepare_events` rejects such a message like any other that is no envelope.

What robots are to hear of an event, once it is synced: an ack, a refusal, or nothing.

What a recorder has done so far, as numbers.
"""

import itertools
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from pydantic import ValidationError

from eventsrc.append import PreparedEvent, prepare_events
from eventsrc.envelope import ENVELOPE_VERSION, KeyframeId, Offset, RunId
from eventsrc.errors import LogError
from eventsrc.gap_history import forget_ledger, save_ledger
from eventsrc.gaps import Gap, GapLedger, Source
from eventsrc.ingest import Rejected
from eventsrc.log import LogWriter
from eventsrc.robot.acks import (
    MAX_PER_ACK,
    SENT_SUFFIX,
    Ack,
    Refusal,
    Refusals,
    Sent,
    ack_key,
    payload_sha256,
    refusal_key,
)
from eventsrc.system_events import LOSS_KEY, Loss
from eventsrc.transport.session import Received

from .queue import Inbox


class Unsynced(NamedTuple):
    """What follows from an event once it is synced. ``run_id`` is None for what counts no
    keyframes: a rejected payload, or a form older than the envelope. ``refusal`` is what to say
    of a rejected payload, ``key`` what it came under, ``sha256`` names the bytes of an envelope."""

    offset: Offset
    key: str
    refusal: Refusal | None
    run_id: RunId | None
    keyframe_id: KeyframeId | None
    sha256: str


def unsynced(offset: Offset, message: Received, judged: PreparedEvent) -> Unsynced:
    """What follows from ``message``, which gets into the log at ``offset``."""
    event, verdict = judged
    key = message.key
    if isinstance(verdict, Rejected):
        return Unsynced(offset, key, Refusal.of(message.payload, verdict.reason), None, None, "")
    if event.version != ENVELOPE_VERSION:
        return Unsynced(offset, key, None, None, None, "")
    digest = payload_sha256(message.payload)
    return Unsynced(offset, key, None, verdict.run_id, verdict.keyframe_id, digest)


class Answers:
    """The answers to what one sync made durable: `note` each event, then send `messages`."""

    def __init__(self) -> None:
        self._synced: defaultdict[tuple[RunId, str], list[str]] = defaultdict(list)
        self._refusals: defaultdict[str, list[Refusal]] = defaultdict(list)

    def note(self, event: Unsynced) -> None:
        """``event`` is synced."""
        if event.run_id is not None:
            self._synced[event.run_id, event.key].append(event.sha256)
        if event.refusal is not None:
            self._refusals[event.key].append(event.refusal)

    def messages(self, log_id: str) -> Iterator[tuple[str, bytes]]:
        """Key and payload of each."""
        for (run_id, key), digests in self._synced.items():
            for start in range(0, len(digests), MAX_PER_ACK):
                some = tuple(digests[start : start + MAX_PER_ACK])
                ack = Ack(run_id=run_id, key=key, log_id=log_id, sha256=some)
                yield ack_key(run_id), ack.encode()
        for key, refused in self._refusals.items():
            yield refusal_key(key), Refusals(log_id=log_id, refused=tuple(refused)).encode()


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """Counted since this recorder began, but for what the log lacks, its end and the queue.

    ``recorded`` are envelopes that are synced, ``rejected`` payloads that are kept under
    ``mapfold/rejected``. ``queue_full``, ``too_large`` and ``transport_missed`` are messages that
    were sent and are not in the log. ``missing`` are the keyframes that the log's runs lack now,
    whatever the cause and whichever recorder lost them, and ``missing_before`` were lacking when
    this one began; a message lost in the queue is usually missing as well. ``unwritten`` are
    messages that were received and not written, because the log could not be written any more: if
    the next start finds some of them on the disk all the same, the better. ``unsealed`` segments
    are finished and wait to be sealed, ``sealing_error`` says why if that fails; it costs room on
    the disk and loses nothing. ``faults`` are what became of segment files that somebody took
    away, cut short or wrote to, and ``lost_from_log`` how many recorded events were in them.
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
    too_large: int = 0
    unwritten: int = 0
    unsealed: int = 0
    sealing_error: str | None = None
    lost_from_log: int = 0
    faults: tuple[str, ...] = ()

    @property
    def lost(self) -> int:
        """Messages that were sent and are not in the log, or are no longer."""
        on_the_way = self.queue_full + self.too_large + self.transport_missed
        return on_the_way + self.unwritten + self.lost_from_log

    @property
    def clean(self) -> bool:
        """True when this recorder lost nothing, rejected nothing and left no new gap."""
        return not (self.rejected or self.lost or self.missing > self.missing_before)


Answer = Callable[[str, bytes], None]
"""Sends a payload under a key."""

_BATCH: Final = 256
_TOGETHER: Final = 16
"""How many are checked at a time: enough to save time, few enough to stay in the cache."""
_TOGETHER_BYTES: Final = 1024 * 1024
"""After how many bytes fewer are checked at a time: what is read of them is held together."""
_IDLE_S: Final = 0.25
_UNSYNCED_S: Final = 0.005
"""How long to wait for more while a group commit is due: a tenth of the default group."""
_LOSSES_EVERY_NS: Final = 1_000_000_000
_FIRST_SAVE_NS: Final = 1_000_000_000
_SAVE_EVERY_NS: Final = 60_000_000_000
"""The ledger is saved after one second, and then after twice as long as the time before, up to a
minute: a recorder that was killed leaves at most half of what it recorded to be read again, or a
minute of it."""


class _Told(NamedTuple):
    """What a robot said when the log's next offset was ``offset``."""

    offset: Offset
    sent: Sent


class Writing:
    """The work of the writer's thread: `run` is its whole life."""

    def __init__(
        self,
        inbox: Inbox,
        writer: LogWriter,
        ledger: GapLedger[RunId] | None,
        answer: Answer,
        *,
        max_events: int | None,
        report_gaps: bool,
        max_payload_bytes: int,
    ) -> None:
        self._inbox = inbox
        self._writer = writer
        self._ledger: GapLedger[RunId] = GapLedger() if ledger is None else ledger
        self._saves = ledger is not None  # one that does not know the whole log is not its ledger
        self._answer = answer
        self._room = max_events
        self._report_gaps = report_gaps
        self._max_payload_bytes = max_payload_bytes
        self._losses_due_ns = time.monotonic_ns() + _LOSSES_EVERY_NS
        self._save_after_ns = _FIRST_SAVE_NS
        self._save_due_ns = time.monotonic_ns() + self._save_after_ns
        self._unsynced: deque[Unsynced] = deque()
        self._told: deque[_Told] = deque()
        self._in_hand = 0  # taken from the inbox and not yet given to the log
        self._failed = False
        self._faults = 0
        self._recorded = self._rejected = 0
        self._missing = self._missing_before = self._ledger.missing if report_gaps else 0

    def run(self) -> None:
        """Record until the inbox is closed and empty, or there are as many events as asked for.

        Raises LogError when the log cannot be written; all that was synced is safe.
        """
        try:
            while self._step():
                pass
            self._sync()
            self._write_losses(self._ledger.flush(), self._inbox.take_missed(None))
            self._save()
        except LogError:
            self._failed = True
            raise
        finally:
            self._follow_up()  # what was synced before an error is recorded all the same

    def report(self) -> RecorderReport:
        """The numbers now; may be asked for from any thread."""
        writer = self._writer
        sealing = writer.sealing
        return RecorderReport(
            recorded=self._recorded,
            rejected=self._rejected,
            queue_full=self._inbox.overflowed,
            too_large=self._inbox.too_large,
            transport_missed=self._inbox.missed,
            missing=self._missing,
            missing_before=self._missing_before,
            queue_depth=self._inbox.depth(),
            queue_size=self._inbox.size,
            next_offset=writer.durable_offset if self._failed else writer.next_offset,
            unwritten=self._unwritten(),
            unsealed=sealing.waiting,
            sealing_error=None if sealing.error is None else str(sealing.error),
            lost_from_log=sum(fault.lost_events for fault in writer.faults),
            faults=tuple(map(str, writer.faults)),
        )

    def _unwritten(self) -> int:
        if not self._failed:
            return 0
        return len(self._unsynced) + self._in_hand + self._inbox.depth()

    def _step(self) -> bool:
        """One batch and what follows from it; False when there will be no more."""
        limit = _BATCH if self._room is None else min(_BATCH, self._room)
        closed = self._inbox.closed  # before taking: what came before the closing is still taken
        waiting = self._writer.durable_offset < self._writer.next_offset
        taken = self._inbox.take(limit, _UNSYNCED_S if waiting else _IDLE_S)
        batch = [message for message in taken if not message.key.endswith(SENT_SUFFIX)]
        self._in_hand = len(batch)
        for messages in _portions(batch):
            self._record(messages)
        if len(batch) < len(taken):
            self._take_told(taken)
        self._writer.commit_if_due()
        self._follow_up()
        now_ns = time.monotonic_ns()
        if now_ns >= self._losses_due_ns:
            self._losses_due_ns = now_ns + _LOSSES_EVERY_NS
            self._write_losses(self._ledger.due(now_ns), self._inbox.take_missed(now_ns))
        if now_ns >= self._save_due_ns:
            self._save_after_ns = min(2 * self._save_after_ns, _SAVE_EVERY_NS)
            self._save_due_ns = now_ns + self._save_after_ns
            self._save()
        if self._room is not None:
            self._room -= len(batch)
        return bool(taken or not closed) and self._room != 0

    def _record(self, messages: list[Received]) -> None:
        payloads = [(message.key, message.payload) for message in messages]
        judged = prepare_events(self._writer, payloads, max_bytes=self._max_payload_bytes)
        # Noted first: should appending fail in the middle, what was synced by then still counts.
        offsets = map(Offset, itertools.count(self._writer.next_offset))
        self._unsynced.extend(map(unsynced, offsets, messages, judged))
        self._in_hand -= len(messages)
        self._writer.append_all([event for event, _ in judged])

    def _take_told(self, taken: list[Received]) -> None:
        for message in taken:
            if message.key.endswith(SENT_SUFFIX):
                try:
                    sent = Sent.decode(message.payload)
                except ValidationError:
                    continue  # not from a robot we understand, so it has said nothing
                self._told.append(_Told(self._writer.next_offset, sent))

    def _follow_up(self) -> None:
        """Everything synced since the last call: recorded, counted, answered."""
        durable = self._writer.durable_offset
        self._forget_lost()  # after `durable` was read: no fault before it is overlooked
        now_ns = time.monotonic_ns()
        if self._unsynced and self._unsynced[0].offset < durable:
            self._follow_events(durable, now_ns)
        while self._told and self._told[0].offset <= durable:
            sent = self._told.popleft().sent
            self._ledger.expect(sent.run_id, sent.last, now_ns)

    def _follow_events(self, durable: Offset, now_ns: int) -> None:
        waiting, answers, ledger = self._unsynced, Answers(), self._ledger
        rejected, before = 0, len(waiting)
        while waiting and waiting[0].offset < durable:
            event = waiting.popleft()
            rejected += event.refusal is not None
            run_id, keyframe_id = event.run_id, event.keyframe_id
            if run_id is not None and keyframe_id is not None:
                ledger.record(run_id, keyframe_id, now_ns)
            answers.note(event)
        self._rejected += rejected
        self._recorded += before - len(waiting) - rejected
        for key, payload in answers.messages(self._writer.log_id):
            self._answer(key, payload)

    def _forget_lost(self) -> None:
        """Answer nothing that was synced in a file which has been given up since."""
        faults = self._writer.faults
        if len(faults) == self._faults:
            return
        self._faults = len(faults)
        lost = [(fault.base, fault.following) for fault in faults if fault.lost_events]
        if not lost:
            return
        kept = [e for e in self._unsynced if not any(a <= e.offset < b for a, b in lost)]
        self._unsynced = deque(kept)
        if self._saves:
            self._saves = False
            forget_ledger(self._writer.path)

    def _sync(self) -> Offset:
        """Make everything durable, so that the ledger is that of the whole log; its end."""
        next_offset = self._writer.sync()
        self._follow_up()
        return next_offset

    def _save(self) -> None:
        next_offset = self._sync()
        if self._saves:
            save_ledger(self._writer.path, self._writer.log_id, next_offset, self._ledger)

    def _write_losses(self, missing: list[Gap[RunId]], missed: list[Gap[str]]) -> None:
        """``missing`` are keyframes, ``missed`` publishers' own numbers."""
        for gap in missing if self._report_gaps else ():
            self._append_loss(_loss("keyframe_gap", gap))
        for key, count in self._inbox.take_overflow().items():
            self._append_loss(Loss(publisher=key, count=count, cause="queue_full"))
        for key, count in self._inbox.take_too_large().items():
            self._append_loss(Loss(publisher=key, count=count, cause="too_large"))
        for of_source in missed:
            self._append_loss(_loss("transport_miss", of_source))
        self._missing = self._ledger.missing if self._report_gaps else 0

    def _append_loss(self, loss: Loss) -> None:
        self._writer.append(LOSS_KEY, loss.model_dump_json().encode())


def _portions(messages: Sequence[Received]) -> Iterator[list[Received]]:
    """``messages`` in portions to be checked together."""
    portion: list[Received] = []
    size = 0
    for message in messages:
        portion.append(message)
        size += len(message.payload)
        if len(portion) == _TOGETHER or size >= _TOGETHER_BYTES:
            yield portion
            portion, size = [], 0
    if portion:
        yield portion


def _loss(cause: Literal["keyframe_gap", "transport_miss"], gap: Gap[Source]) -> Loss:
    return Loss(publisher=gap.run_id, first=gap.first, last=gap.last, count=gap.count, cause=cause)
