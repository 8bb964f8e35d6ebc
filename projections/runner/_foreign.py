"""Which embedding space a fold expected where it left embeddings out, and which one came."""

import sys
from dataclasses import dataclass

from eventsrc.ingest import Accepted
from eventsrc.log import LogReader
from eventsrc.upcast import read_envelope

from ._fold import LiveFold


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
