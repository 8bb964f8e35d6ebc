"""Whether a projection was made from the beginning of this very log, with these settings."""

from pathlib import Path

from eventsrc.log import LogReader
from projections.errors import ProjectionMismatch, ProjectionMissing
from projections.settings import Settings
from projections.sink import Checkpoint, SinkName
from projections.sinks._advice import remake
from projections.sinks._checkpoint import event_hash, refuse_other_origin


def refuse_misfit(
    found: Checkpoint, sink: SinkName, where: str, log: Path, reader: LogReader, settings: Settings
) -> None:
    """Raise ProjectionMismatch unless ``found`` is of ``log`` as it is, and of ``settings``.

    ``where`` is the database, for the message.
    """
    advice = remake(log, settings)
    refuse_other_origin(found, sink, where, reader.log_id, settings, advice)
    if found.next_offset > reader.next_offset:
        raise ProjectionMismatch(
            f"{where}: {found.next_offset:,} events are in the {sink} there, but {log} has only"
            f" {reader.next_offset:,}; {advice}"
        )
    for event in reader.read(max(0, found.next_offset - 1), found.next_offset):
        if event_hash(event) != found.last_event:
            raise ProjectionMismatch(
                f"{log}: the event at offset {event.offset:,} is not the one that is in the"
                f" {sink}; {advice}"
            )


def gone(
    found: Checkpoint, sink: SinkName, where: str, log: Path, settings: Settings
) -> ProjectionMissing:
    """The error for a checkpoint whose rows somebody has dropped."""
    return ProjectionMissing(
        f"{where}: {found.next_offset:,} events are in the {sink} by its checkpoint, but somebody"
        f" has dropped what they were in; {remake(log, settings)}"
    )
