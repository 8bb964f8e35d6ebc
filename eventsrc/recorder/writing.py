"""The writer's thread: from the queue into the log, and what follows from it.

* One thread owns the LogWriter. It takes batches from the inbox, appends, and lets the log commit.
* Nothing follows from an event before it is synced: only then does it enter the gap ledger, count
  as recorded, and get acknowledged to its robot.
* Losses are written about once a second, not one by one: a queue that overflows is busy enough.
* Keys under ``mapfold/`` are our own. From the network they could forge a loss or a command, so
  `judge_payloads` rejects such a message like any other that is no envelope.
"""

import itertools
import time
from collections import defaultdict, deque
from collections.abc import Callable
from typing import Final, Literal, NamedTuple

from eventsrc._zenoh import Received
from eventsrc.acks import Ack
from eventsrc.append import Judged, judge_payloads
from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.ingest import Rejected
from eventsrc.ledger import save_ledger
from eventsrc.log import LogWriter
from eventsrc.losses import Gap, GapLedger
from eventsrc.system_events import LOSS_KEY, Loss

from .inbox import Inbox
from .report import RecorderReport

Acknowledge = Callable[[Ack], None]
Cause = Literal["queue_full", "transport_miss"]

_BATCH: Final = 256
_TOGETHER: Final = 16
"""How many are checked at a time: enough to save time, few enough to stay in the cache."""
_IDLE_S: Final = 0.25
_UNSYNCED_S: Final = 0.005
"""How long to wait for more while a group commit is due: a tenth of the default group."""
_LOSSES_EVERY_NS: Final = 1_000_000_000
_SAVE_EVERY_NS: Final = 60_000_000_000
"""So a recorder that was killed leaves a minute of its log to be read again, not the whole."""


class _Unsynced(NamedTuple):
    """What follows from an event once it is synced. ``run_id`` is None for what counts no
    keyframes: a rejected payload, or a form older than the envelope."""

    offset: int
    accepted: bool
    run_id: str | None
    keyframe_id: int


def _unsynced(offset: int, judged: Judged) -> _Unsynced:
    event, verdict = judged
    if isinstance(verdict, Rejected):
        return _Unsynced(offset, False, None, 0)
    if event.version != ENVELOPE_VERSION:
        return _Unsynced(offset, True, None, 0)
    return _Unsynced(offset, True, verdict.run_id, verdict.keyframe_id)


class Writing:
    """The work of the writer's thread: `run` is its whole life."""

    def __init__(
        self,
        inbox: Inbox,
        writer: LogWriter,
        ledger: GapLedger | None,
        acknowledge: Acknowledge,
        *,
        max_events: int | None,
        report_gaps: bool,
        max_payload_bytes: int,
    ) -> None:
        self._inbox = inbox
        self._writer = writer
        self._ledger = GapLedger() if ledger is None else ledger
        self._saves = ledger is not None  # one that does not know the whole log is not its ledger
        self._acknowledge = acknowledge
        self._room = max_events
        self._report_gaps = report_gaps
        self._max_payload_bytes = max_payload_bytes
        self._losses_due_ns = time.monotonic_ns() + _LOSSES_EVERY_NS
        self._save_due_ns = time.monotonic_ns() + _SAVE_EVERY_NS
        self._unsynced: deque[_Unsynced] = deque()
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
            self._write_losses(self._ledger.flush())
            self._save()
        finally:
            self._follow_up()  # what was synced before an error is recorded all the same

    def report(self) -> RecorderReport:
        """The numbers now; may be asked for from any thread."""
        return RecorderReport(
            recorded=self._recorded,
            rejected=self._rejected,
            queue_full=self._inbox.overflowed,
            transport_missed=self._inbox.missed,
            missing=self._missing,
            missing_before=self._missing_before,
            queue_depth=self._inbox.depth(),
            queue_size=self._inbox.size,
            next_offset=self._writer.next_offset,
        )

    def _step(self) -> bool:
        """One batch and what follows from it; False when there will be no more."""
        limit = _BATCH if self._room is None else min(_BATCH, self._room)
        closed = self._inbox.closed  # before taking: what came before the closing is still taken
        waiting = self._writer.durable_offset < self._writer.next_offset
        batch = self._inbox.take(limit, _UNSYNCED_S if waiting else _IDLE_S)
        for start in range(0, len(batch), _TOGETHER):
            self._record(batch[start : start + _TOGETHER])
        self._writer.commit_if_due()
        self._follow_up()
        now_ns = time.monotonic_ns()
        if now_ns >= self._losses_due_ns:
            self._losses_due_ns = now_ns + _LOSSES_EVERY_NS
            self._write_losses(self._ledger.due(now_ns))
        if now_ns >= self._save_due_ns:
            self._save_due_ns = now_ns + _SAVE_EVERY_NS
            self._save()
        if self._room is not None:
            self._room -= len(batch)
        return bool(batch or not closed) and self._room != 0

    def _record(self, messages: list[Received]) -> None:
        judged = judge_payloads(self._writer, messages, max_bytes=self._max_payload_bytes)
        # Noted first: should appending fail in the middle, what was synced by then still counts.
        self._unsynced.extend(map(_unsynced, itertools.count(self._writer.next_offset), judged))
        self._writer.append_all([event for event, _ in judged])

    def _follow_up(self) -> None:
        """Everything synced since the last call: recorded, counted, acknowledged."""
        durable = self._writer.durable_offset
        unsynced = self._unsynced
        if not unsynced or unsynced[0].offset >= durable:
            return
        now_ns = time.monotonic_ns()
        synced: defaultdict[str, list[int]] = defaultdict(list)
        while unsynced and unsynced[0].offset < durable:
            _, accepted, run_id, keyframe_id = unsynced.popleft()
            self._recorded += accepted
            self._rejected += not accepted
            if run_id is not None:
                self._ledger.record(run_id, keyframe_id, now_ns)
                synced[run_id].append(keyframe_id)
        for run_id, keyframe_ids in synced.items():
            stretches = _stretches(self._ledger, run_id, keyframe_ids)
            ack = Ack(run_id=run_id, log_id=self._writer.log_id, stretches=stretches)
            self._acknowledge(ack)

    def _sync(self) -> int:
        """Make everything durable, so that the ledger is that of the whole log; its end."""
        next_offset = self._writer.sync()
        self._follow_up()
        return next_offset

    def _save(self) -> None:
        next_offset = self._sync()
        if self._saves:
            save_ledger(self._writer.path, self._writer.log_id, next_offset, self._ledger)

    def _write_losses(self, gaps: list[Gap]) -> None:
        for gap in gaps if self._report_gaps else ():
            self._append_loss(
                Loss(
                    publisher=gap.run_id,
                    first=gap.first,
                    last=gap.last,
                    count=gap.count,
                    cause="keyframe_gap",
                )
            )
        self._write_counts("queue_full", self._inbox.take_overflow())
        self._write_counts("transport_miss", self._inbox.take_missed())
        self._missing = self._ledger.missing if self._report_gaps else 0

    def _write_counts(self, cause: Cause, counts: dict[str, int]) -> None:
        for publisher, count in counts.items():
            self._append_loss(Loss(publisher=publisher, count=count, cause=cause))

    def _append_loss(self, loss: Loss) -> None:
        self._writer.append(LOSS_KEY, loss.model_dump_json().encode())


def _stretches(
    ledger: GapLedger, run_id: str, keyframe_ids: list[int]
) -> tuple[tuple[int, int], ...]:
    """The recorded stretches these keyframes lie in, in order, each once."""
    found: list[tuple[int, int]] = []
    for keyframe_id in sorted(keyframe_ids):
        if found and keyframe_id <= found[-1][1]:
            continue
        stretch = ledger.stretch(run_id, keyframe_id)
        if stretch is not None:
            found.append(stretch)
    return tuple(found)
