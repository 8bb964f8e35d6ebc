"""How many events a log lacks, by its own word: reported losses, less what came late after all."""

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict, ValidationError

from eventsrc.losses import Gap, GapLedger
from eventsrc.system_events import LOSS_KEY, Loss, is_system_key

from .event import Event
from .reader import LogReader


class _Identity(BaseModel):
    model_config = ConfigDict(extra="ignore")

    run_id: str
    keyframe_id: int


def count_lost(reader: LogReader) -> int:
    """Reads the losses, and everything behind the first gap of keyframes, which may close it."""
    ledger = GapLedger()
    others = 0
    for event in _losses_and_what_follows(reader):
        if event.key == LOSS_KEY:
            loss = _loss(event)
            if loss is None:
                continue
            if loss.cause == "keyframe_gap" and loss.first is not None and loss.last is not None:
                ledger.assume(Gap(loss.publisher, loss.first, loss.last), now_ns=0)
            else:
                others += loss.count
        else:
            _close(ledger, event)
    return others + ledger.missing_reported()


def _losses_and_what_follows(reader: LogReader) -> Iterator[Event]:
    for event in reader.read(keys={LOSS_KEY}):
        loss = _loss(event)
        if loss is not None and loss.cause == "keyframe_gap":
            yield from reader.read(event.offset)
            return
        yield event


def _loss(event: Event) -> Loss | None:
    try:
        return Loss.model_validate_json(event.payload)
    except ValidationError:  # `log verify` names it
        return None


def _close(ledger: GapLedger, event: Event) -> None:
    if is_system_key(event.key):
        return
    try:
        found = _Identity.model_validate_json(event.payload)
    except (ValidationError, RecursionError):
        return
    ledger.record(found.run_id, found.keyframe_id, now_ns=0)
