"""First embedding of a log that is outside the map's space, so that the fold left it out."""

import sys
from dataclasses import dataclass

from eventsrc.envelope.forms import read_envelope
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader

from .live_fold import LiveFold


@dataclass(frozen=True, slots=True)
class ForeignEmbedding:
    """An embedding that is outside the map's space. A model is None when it has no name.

    ``map_dim`` is None when the map has no embedding: none had the space that the settings ask for.
    """

    offset: Offset
    det_id: str
    model: str | None
    dim: int
    map_model: str | None
    map_dim: int | None


def first_foreign_embedding(fold: LiveFold, reader: LogReader) -> ForeignEmbedding | None:
    """None when there is none. Read again from the log, as the fold does not keep it."""
    first = next((o for o in fold.view.observations if o.foreign_space), None)
    if first is None:
        return None
    offset, space = fold.view.keyframes[first.keyframe].offset, fold.map.space
    (event,) = reader.read(offset, Offset(offset + 1))
    parsed = read_envelope(event, max_bytes=sys.maxsize)
    assert isinstance(parsed, Accepted)  # noqa: S101 - it was folded
    vector = parsed.vectors[parsed.det_ids.index(first.det_id)]
    assert vector is not None  # noqa: S101 - it was found to be of another space
    dim = space.dim if space.is_decided else None
    return ForeignEmbedding(
        offset, first.det_id, first.embedding_model, len(vector), space.model, dim
    )
