"""Vectors of another embedding space for detections of a log, as ``mapfold/embeddings`` events.

`mapfold reembed` appends them, and then one command, ``reembed``, which puts them into force. A map
of their space uses them for detections that were recorded without a vector of it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pybase64
from numpy.typing import NDArray
from pydantic import ValidationError

from .model import DetId, describe_error
from .system_events import Embeddings


class InvalidEmbeddings(ValueError):
    """A payload is no embeddings event; the message names the field, its value and the rule."""


class NewVectors(NamedTuple):
    """Vectors of a space, shape (detections, dimension), by the encoder with this SHA-256."""

    space: str
    encoder: str
    det_ids: tuple[DetId, ...]
    vectors: NDArray[np.float32]

    def encode(self) -> bytes:
        """The event's JSON."""
        raw = np.ascontiguousarray(self.vectors, "<f4").tobytes()
        return (
            Embeddings(
                space=self.space,
                encoder=self.encoder,
                dim=self.vectors.shape[1],
                det_ids=self.det_ids,
                vectors=pybase64.b64encode(raw).decode(),
            )
            .model_dump_json()
            .encode()
        )


def is_usable(vectors: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which rows of ``vectors`` have a direction: are finite and not zero. Shape (rows,)."""
    largest = np.abs(vectors).max(axis=1)
    usable: NDArray[np.bool_] = np.isfinite(largest) & (largest > 0.0)
    return usable


def decode_embeddings(payload: bytes) -> NewVectors:
    """The vectors of an event. Raises InvalidEmbeddings."""
    try:
        found = Embeddings.model_validate_json(payload)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"])) or "the event"
        raise InvalidEmbeddings(f"{place}: {describe_error(first)}") from None
    try:
        raw = pybase64.b64decode(found.vectors, None, True)
    except ValueError:
        raise InvalidEmbeddings("vectors: not base64") from None
    if len(raw) != 4 * found.dim * len(found.det_ids):
        raise InvalidEmbeddings(
            f"vectors: {len(raw):,} bytes, where {len(found.det_ids):,} vectors of dimension"
            f" {found.dim:,} take {4 * found.dim * len(found.det_ids):,}"
        )
    vectors = np.frombuffer(raw, "<f4").reshape(-1, found.dim)
    bad = np.flatnonzero(~is_usable(vectors))
    if len(bad):
        raise InvalidEmbeddings(
            f"vectors: that of {found.det_ids[bad[0]]!r} holds NaN or infinity, or is zero"
        )
    det_ids: Sequence[str] = found.det_ids
    if len(set(det_ids)) != len(det_ids):
        raise InvalidEmbeddings("det_ids: one stands twice")
    return NewVectors(found.space, found.encoder, tuple(map(DetId, det_ids)), vectors)
