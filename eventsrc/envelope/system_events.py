"""mapfold's own events, in the same log and offset space as the envelopes.

``mapfold/rejected``  a payload that is no valid envelope, with its bytes and the reason
``mapfold/loss``      a detected gap: publisher, first and last missing, cause
``mapfold/command``   a command (`.commands`), appended by `mapfold edit` or, at its
                      request, by a recorder
``mapfold/ros``       how envelopes are made of the messages of ROS behind it
                      (`eventsrc.ros.derivation`)
``mapfold/map``       an occupancy grid: where walls are (`.occupancy_map`)
``mapfold/embeddings``  vectors of another space for older detections (`NewVectors`)
``mapfold/drop``      classes whose detections are never stored (`.dropped_classes`)
``mapfold/redaction`` what was erased from the log, by whom and why (`eventsrc.log.redact`)
``mapfold/redacted``  a tombstone, in place of an event that was erased

The docstrings of the models are part of the JSON schema in every segment: do not change them.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from typing import Annotated, Final, Literal, NamedTuple

import numpy as np
import pybase64
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from .model import MAX_DIMENSION, DetId, Text, describe_error

RESERVED_PREFIX = "mapfold/"
REJECTED_KEY = "mapfold/rejected"
LOSS_KEY = "mapfold/loss"
COMMAND_KEY = "mapfold/command"
MAP_KEY = "mapfold/map"
ROS_KEY = "mapfold/ros"
EMBEDDINGS_KEY = "mapfold/embeddings"
DROP_KEY = "mapfold/drop"
REDACTION_KEY = "mapfold/redaction"
REDACTED_KEY = "mapfold/redacted"


def is_system_key(key: str) -> bool:
    """Whether ``key`` is for mapfold's own events; every other key carries envelopes."""
    return key.startswith(RESERVED_PREFIX)


MAX_KEPT_BYTES: Final = 64 * 1024 * 1024
"""Refused payloads up to this size are kept whole; in base64 one still fits into an event."""
EXCERPT_BYTES: Final = 4_096
"""First bytes that are kept of a larger one."""


class Excerpt(NamedTuple):
    """What is kept of a refused payload that is too large to be kept whole: its first bytes, and
    size and SHA-256 (hex digits) of the whole."""

    start: bytes
    size: int
    sha256: str

    @classmethod
    def of(cls, pieces: Iterable[bytes]) -> "Excerpt":
        """The excerpt of the payload that ``pieces`` make up, of which one is held at a time."""
        sha, start, size = hashlib.sha256(), b"", 0
        for piece in pieces:
            if len(start) < EXCERPT_BYTES:
                start += piece[: EXCERPT_BYTES - len(start)]
            sha.update(piece)
            size += len(piece)
        return cls(start, size, sha.hexdigest())

    def reason(self, most: int = MAX_KEPT_BYTES) -> str:
        """The reason for which the payload was refused where up to ``most`` bytes are kept."""
        return (
            f"payload of {self.size:,} bytes, more than the {most:,} that are kept whole; its "
            f"first {len(self.start):,} bytes and the SHA-256 of all are kept"
        )


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")


class RejectedPayload(_Model):
    """The content of a ``mapfold/rejected`` event. ``payload`` is base64 of the refused bytes."""

    key: str
    reason: str
    payload: str
    size: int | None = None
    """With ``sha256``, of the whole payload if ``payload`` is an excerpt of it."""
    sha256: str | None = None

    @staticmethod
    def encode(key: str, reason: str, raw: bytes | Excerpt) -> bytes:
        """The event's JSON, for ``raw`` that came under ``key`` and was refused for ``reason``.

        Built from bytes: ``raw`` may be large, and each conversion to text would copy it.
        """
        fields: dict[str, str | int] = {"key": key, "reason": reason}
        if isinstance(raw, Excerpt):
            fields |= {"size": raw.size, "sha256": raw.sha256}
            raw = raw.start
        head = json.dumps(fields, separators=(",", ":"))
        return b"".join((head[:-1].encode(), b',"payload":"', pybase64.b64encode(raw), b'"}'))

    @property
    def raw(self) -> bytes:
        """The refused bytes, as far as they are kept."""
        return pybase64.b64decode(self.payload)


class Loss(_Model):
    """The content of a ``mapfold/loss`` event.

    ``publisher`` names who it was lost from: a run id (cause ``keyframe_gap``), a Zenoh source id
    (``transport_miss``), the key (``queue_full``, ``too_large``), or ``log`` where a recovered log
    lacks the event of this very offset (``rot``). ``first`` and ``last`` are the first and last
    missing number in that publisher's own counting, None where nothing was counted.
    """

    publisher: str
    first: int | None = None
    last: int | None = None
    count: Annotated[int, Field(ge=1)]
    cause: Literal["keyframe_gap", "queue_full", "too_large", "transport_miss", "rot"]


MAX_REEMBEDDED = 4_096
"""Bound of the detections in an event on ``mapfold/embeddings``."""


class Embeddings(BaseModel):
    """The content of a ``mapfold/embeddings`` event: vectors of the space ``space`` for detections
    that were recorded without one of it.

    ``vectors`` is base64 of float32, little endian, ``dim`` values for each of ``det_ids``.
    ``encoder`` is the SHA-256 of the model that made them, in hex digits.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="ignore", allow_inf_nan=False)

    space: Text
    encoder: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    dim: Annotated[int, Field(ge=1, le=MAX_DIMENSION)]
    det_ids: Annotated[tuple[Text, ...], Field(min_length=1, max_length=MAX_REEMBEDDED)]
    vectors: str


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
