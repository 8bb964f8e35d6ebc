"""The gap ledger of a log: folded from its events when a recorder opens it, or when one asks.

Of an envelope only two fields are needed, and reading those two is several times quicker than the
whole door. What the short reading does not understand goes through the door all the same.
"""

import time
from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, ValidationError

from .ingest import Accepted, ingest
from .log import Event, LogReader
from .losses import DEFAULT_SETTLE_NS, Gap, GapLedger
from .system_events import LOSS_KEY, Loss, is_system_key


class _Identity(BaseModel):
    """The two fields of an envelope that say which keyframe it is."""

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore")

    run_id: str
    keyframe_id: int


def ledger_of(
    reader: LogReader, *, settle_ns: int = DEFAULT_SETTLE_NS, now_ns: int | None = None
) -> GapLedger:
    """The ledger of a whole log.

    Holes the log never reported count as open since ``now_ns`` (by default: now, monotonic clock).
    """
    now_ns = time.monotonic_ns() if now_ns is None else now_ns
    return fold_ledger(reader.read(), GapLedger(settle_ns), now_ns)


def fold_ledger(events: Iterable[Event], ledger: GapLedger, now_ns: int) -> GapLedger:
    """Take ``events`` into ``ledger``, which is also returned."""
    for event in events:
        if event.key == LOSS_KEY:
            _take_loss(ledger, event.payload)
        elif not is_system_key(event.key):
            identity = _identity(event.payload)
            if identity is not None:
                ledger.record(*identity, now_ns)
    return ledger


def _take_loss(ledger: GapLedger, payload: bytes) -> None:
    loss = Loss.model_validate_json(payload)
    if loss.cause == "keyframe_gap" and loss.first is not None and loss.last is not None:
        ledger.mark_reported(Gap(loss.publisher, loss.first, loss.last))


def _identity(payload: bytes) -> tuple[str, int] | None:
    try:
        found = _Identity.model_validate_json(payload)
    except (ValidationError, RecursionError):
        outcome = ingest(payload)
        if not isinstance(outcome, Accepted):
            return None  # an envelope the fold cannot read either; `log verify` names it
        return outcome.envelope.run_id, outcome.envelope.keyframe_id
    return found.run_id, found.keyframe_id
