"""How many events a log lacks, by its own word: reported losses, less what came late after all."""

from collections.abc import Iterator

from pydantic import BaseModel, ConfigDict, ValidationError

from eventsrc.losses import Gap
from eventsrc.system_events import LOSS_KEY, Loss, is_system_key

from .event import Event
from .reader import LogReader


class _Identity(BaseModel):
    model_config = ConfigDict(extra="ignore")

    run_id: str
    keyframe_id: int


def count_lost(reader: LogReader) -> int:
    """Reads the losses, and everything behind the first gap of keyframes, which may close it."""
    open_gaps: dict[str, set[int]] = {}
    others = 0
    for event in _losses_and_what_follows(reader):
        if event.key == LOSS_KEY:
            loss = _loss(event)
            if loss is None:
                continue
            if loss.cause == "keyframe_gap" and loss.first is not None and loss.last is not None:
                gap = Gap(loss.publisher, loss.first, loss.last)
                open_gaps.setdefault(gap.run_id, set()).update(range(gap.first, gap.last + 1))
            else:
                others += loss.count
        else:
            _close(open_gaps, event)
    return others + sum(map(len, open_gaps.values()))


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


def _close(open_gaps: dict[str, set[int]], event: Event) -> None:
    if is_system_key(event.key):
        return
    try:
        found = _Identity.model_validate_json(event.payload)
    except (ValidationError, RecursionError):
        return
    open_gaps.get(found.run_id, set()).discard(found.keyframe_id)
