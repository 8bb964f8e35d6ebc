"""The vectors that a log's ``reembed`` commands put into force, for the maps of their space."""

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eventsrc.advised import advised
from eventsrc.commands import Reembed
from eventsrc.embeddings import InvalidEmbeddings, decode_embeddings
from eventsrc.envelope import DetId
from eventsrc.log import LogReader
from eventsrc.system_events import EMBEDDINGS_KEY
from projections.corrections import NO_CORRECTIONS, Corrections
from projections.errors import FoldError
from projections.reducers.embedding_space import Reembedded
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings


def new_map(
    reader: LogReader, settings: Settings, corrections: Corrections = NO_CORRECTIONS
) -> SemanticMap:
    """A fold of this log that has folded nothing yet. Raises FoldError, LogDamaged."""
    return with_vectors(SemanticMap(settings, corrections), reader)


def with_vectors(semantic_map: SemanticMap, reader: LogReader) -> SemanticMap:
    """The map, with the vectors of its space that the log has beside those in envelopes. Raises
    FoldError, LogDamaged."""
    known = vectors_of(reader, semantic_map.settings, semantic_map.corrections)
    semantic_map.reembedded = known
    return semantic_map


def vectors_of(
    reader: LogReader, settings: Settings, corrections: Corrections
) -> Reembedded | None:
    """The vectors of the settings' space that the log has beside those in envelopes; None if none
    are in force. Raises FoldError, LogDamaged."""
    commands = corrections.reembedded_for(settings)
    return _read(reader.path, reader.log_id, commands) if commands else None


@lru_cache(maxsize=2)
def _read(log: Path, _log_id: str, commands: tuple[Reembed, ...]) -> Reembedded:
    vectors: dict[DetId, NDArray[np.float32]] = {}
    with LogReader(log) as reader:
        for command in commands:
            digest = hashlib.sha256()
            for event in reader.read(command.first, command.end, keys={EMBEDDINGS_KEY}):
                try:
                    found = decode_embeddings(event.payload)
                except InvalidEmbeddings as error:
                    raise FoldError(event.offset, f"it is on {EMBEDDINGS_KEY}: {error}") from None
                if found.space == command.space:
                    digest.update(event.payload)
                    for det_id, row in zip(found.det_ids, found.vectors, strict=True):
                        vectors.setdefault(det_id, row)
            if digest.hexdigest() != command.sha256:
                raise FoldError(
                    command.first,
                    f"the vectors of {command.space!r} from here to offset {command.end} are not"
                    f" those that command {command.command_id} was given for; run"
                    f" `{advised('log', 'verify')}`, and undo the command to map without them",
                )
    return Reembedded(commands[0].space, vectors)
