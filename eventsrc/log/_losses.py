"""How many events a log lacks, by its own word: reported losses, less what came late after all."""

from collections.abc import Callable

from pydantic import ValidationError

from eventsrc import ledger  # which reads logs by this package's reader, and may be importing it
from eventsrc.losses import gap_of
from eventsrc.system_events import LOSS_KEY, Loss

from .event import Event
from .reader import LogReader


def count_lost(reader: LogReader, note: Callable[[str], None] | None = None) -> int:
    """Reads the losses, and for gaps of keyframes, which may be closed, the log's gap ledger.
    ``note`` is told why a saved one is not used."""
    losses = [loss for event in reader.read(keys={LOSS_KEY}) if (loss := _loss(event)) is not None]
    others = [loss.count for loss in losses if gap_of(loss) is None]
    if len(others) == len(losses):
        return sum(others)
    return sum(others) + ledger.ledger_of(reader, note=note).missing_reported()


def _loss(event: Event) -> Loss | None:
    try:
        return Loss.model_validate_json(event.payload)
    except ValidationError:  # `log verify` names it
        return None
