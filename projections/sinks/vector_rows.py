"""From deltas to rows of ``detection_embeddings``: one row for each searchable detection.

Searchable means: it has an embedding of the map's own space. Rows are written once and never
change. ``det_pk`` is the observation's ordinal + 1 and ``ingested_at`` is when the event was
*logged*, so a row follows from the log alone, to the last bit, whoever writes it and when.
"""

import math
import struct
from datetime import UTC, datetime, timedelta
from typing import Final

import numpy as np
from numpy.typing import NDArray

from eventsrc.frozen import frozen
from projections.deltas import Delta, ObservationAdded
from projections.exact import UM_PER_M, to_float32
from projections.view import MapView

COLUMNS: Final = (
    "det_pk",
    "run_id",
    "det_id",
    "keyframe_id",
    "class_name",
    "confidence",
    "bbox",
    "map_x",
    "map_y",
    "map_yaw",
    "embedding_model",
    "embedding",
    "ingested_at",
)
_REAL: Final = struct.Struct("f")
_REALS: Final = struct.Struct("4f")
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


@frozen(eq=False)
class VectorRow:
    """One row. ``embedding`` is float32 of shape (dim,), ``ingested_us`` µs since the epoch.

    ``bbox`` is rounded to float32 already, as ``real[]`` holds it; a corner beyond float32 is ±inf.
    """

    det_pk: int
    run_id: str
    det_id: str
    keyframe_id: int
    class_name: str
    confidence: float
    bbox: tuple[float, float, float, float]
    pose: tuple[float, float, float] | None
    embedding_model: str | None
    embedding: NDArray[np.float32]
    ingested_us: int

    @property
    def ingested_at(self) -> datetime:
        """``ingested_us`` as PostgreSQL's timestamptz has it."""
        return _EPOCH + timedelta(microseconds=self.ingested_us)


class VectorRows:
    """Collects the rows a stream of deltas adds."""

    def __init__(self) -> None:
        self._waiting: list[tuple[ObservationAdded, int]] = []

    def note(self, delta: Delta, logged_ns: int) -> None:
        """Remember ``delta`` if it adds a row; its event was logged at ``logged_ns``."""
        if type(delta) is ObservationAdded and delta.embedding is not None:
            self._waiting.append((delta, logged_ns))

    @property
    def waiting(self) -> int:
        """How many rows `take` would give."""
        return len(self._waiting)

    def take(self, view: MapView) -> list[VectorRow]:
        """The rows added since the last take."""
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return []
        # One map has one embedding space, so the vectors fit one matrix.
        embeddings = to_float32(np.array([delta.embedding for delta, _ in waiting]))
        return [
            _row(delta, logged_ns, view, embedding)
            for (delta, logged_ns), embedding in zip(waiting, embeddings, strict=True)
        ]


def _row(
    delta: ObservationAdded, logged_ns: int, view: MapView, embedding: NDArray[np.float32]
) -> VectorRow:
    pose = view.keyframes[delta.keyframe].pose
    return VectorRow(
        delta.observation + 1,
        delta.run_id,
        delta.det_id,
        delta.keyframe_id,
        delta.class_name,
        delta.confidence,
        _as_real(delta.bbox),
        None if pose is None else (pose.x_um / UM_PER_M, pose.y_um / UM_PER_M, pose.yaw_rad),
        delta.embedding_model,
        embedding,
        logged_ns // 1000,
    )


def _as_real(bbox: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    try:
        x0, y0, x1, y1 = _REALS.unpack(_REALS.pack(*bbox))
    except OverflowError:
        x0, y0, x1, y1 = (_real(value) for value in bbox)
    return x0, y0, x1, y1


def _real(value: float) -> float:
    try:
        rounded: float = _REAL.unpack(_REAL.pack(value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return rounded
