"""The embedding spaces of a log: how many detections have a vector of each."""

import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from eventsrc.envelope import DetId
from eventsrc.ingest import Accepted
from eventsrc.log import LogReader
from eventsrc.upcast import read_envelope
from projections.settings import Settings

from .log_commands import read_corrections
from .space_vectors import vectors_of


@dataclass(frozen=True, slots=True)
class LogSpace:
    """A space: its model, None where detections name none, and its dimension. ``recorded``
    detections have a vector of it in their envelope, ``reembedded`` others by commands in force."""

    model: str | None
    dim: int
    recorded: int
    reembedded: int


@dataclass(frozen=True, slots=True)
class LogSpaces:
    """``spaces`` by their first vector, those without a recorded one last; ``bare`` of the
    ``detections`` were recorded without a vector. Each det_id counts once."""

    detections: int
    bare: int
    spaces: tuple[LogSpace, ...]


def log_spaces(
    reader: LogReader, progress: Callable[[int, int], None] = lambda *_: None
) -> LogSpaces:
    """Count the spaces of a log, from all its envelopes. Raises FoldError, LogDamaged."""
    corrections = read_corrections(reader)
    recorded: Counter[tuple[str | None, int]] = Counter()
    spaces: dict[DetId, tuple[str | None, int] | None] = {}
    for event in reader.read():
        progress(event.offset + 1, reader.next_offset)
        if not event.is_envelope:
            continue
        accepted = read_envelope(event, max_bytes=sys.maxsize)
        if not isinstance(accepted, Accepted):
            continue
        detections = accepted.envelope.detections
        for det_id, detection, vector in zip(
            accepted.det_ids, detections, accepted.vectors, strict=True
        ):
            if det_id not in spaces:
                space = None if vector is None else (detection.embedding_model, len(vector))
                spaces[det_id] = space
                if space is not None:
                    recorded[space] += 1
    given: Counter[tuple[str | None, int]] = Counter()
    for model, dim in dict.fromkeys((each.space, each.dim) for each in corrections.reembedded):
        chosen = Settings(embedding_model=model, embedding_dim=dim)
        vectors = vectors_of(reader, chosen, corrections)
        given[model, dim] = sum(
            space != (model, dim) and vectors is not None and det_id in vectors
            for det_id, space in spaces.items()
        )
    found = tuple(
        LogSpace(model, dim, recorded[model, dim], given[model, dim])
        for model, dim in dict.fromkeys((*recorded, *given))
    )
    return LogSpaces(len(spaces), sum(space is None for space in spaces.values()), found)
