"""Whether a projection was made from the beginning of this very log, with these settings.

Which embedding space a fold expected where it left embeddings out, and which one came.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from eventsrc.ingest import Accepted
from eventsrc.log import LogReader
from eventsrc.upcast import read_envelope
from projections.errors import ProjectionMismatch, ProjectionMissing
from projections.settings import Settings

from .checkpoints import event_hash, refuse_other_origin, remake
from .shared_fold import LiveFold
from .sink import Checkpoint, SinkName


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


@dataclass(frozen=True, slots=True)
class ForeignEmbedding:
    """The first embedding that is not in the map's space. A model is None when it has no name.

    ``map_dim`` is None for a map that has no embedding at all, as none fitted the settings.
    """

    offset: int
    det_id: str
    model: str | None
    dim: int
    map_model: str | None
    map_dim: int | None


def first_foreign(fold: LiveFold, reader: LogReader) -> ForeignEmbedding | None:
    """What the first one is, None when there is none. The log still has what the fold dropped."""
    first = next((o for o in fold.view.observations if o.foreign_space), None)
    if first is None:
        return None
    offset, space = fold.view.keyframes[first.keyframe].offset, fold.map.space
    (event,) = reader.read(offset, offset + 1)
    door = read_envelope(event, max_bytes=sys.maxsize)
    assert isinstance(door, Accepted)  # noqa: S101 - it was folded
    vector = door.vectors[door.det_ids.index(first.det_id)]
    assert vector is not None  # noqa: S101 - it was found to be of another space
    dim = space.dim if space.is_decided else None
    return ForeignEmbedding(
        offset, first.det_id, first.embedding_model, len(vector), space.model, dim
    )
