"""Rows of ``detection_embeddings``: one for each searchable detection.

Searchable means: it has an embedding of the map's own space. Rows are written once and never
change. ``det_pk`` is the observation's ordinal + 1 and ``ingested_at`` is when the event was
*logged*, so a row follows from the log alone, to the last bit.
"""

import math
import struct
from datetime import UTC, datetime, timedelta
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.model import StatedCamera
from projections.fold.deltas import ObservationAdded, Pose
from projections.fold.exact import UM_PER_M, UnitVector, to_float32
from projections.localize.relocalize.camera import CameraValues, camera_values
from projections.map.changes import BatchChanges
from projections.map.view import MapView

_REAL: Final = struct.Struct("f")
_REALS: Final = struct.Struct("4f")
_EPOCH: Final = datetime(1970, 1, 1, tzinfo=UTC)


class VectorRow(msgspec.Struct, frozen=True, eq=False, gc=False):
    """One row: the delta that adds it; the values of the columns are computed on access.

    ``keyframe_pose`` is None when the robot had no pose, ``stated`` when the envelope states no
    camera; the event was logged at ``logged_ns``.
    """

    added: ObservationAdded
    keyframe_pose: Pose | None
    stated: StatedCamera | None
    logged_ns: int

    @property
    def det_pk(self) -> int:
        """The key: the observation's ordinal + 1."""
        return self.added.observation + 1

    @property
    def bbox(self) -> tuple[float, float, float, float]:
        """Rounded to float32, as ``real[]`` holds it; a corner beyond float32 is ±inf."""
        try:
            x0, y0, x1, y1 = _REALS.unpack(_REALS.pack(*self.added.bbox))
        except OverflowError:
            x0, y0, x1, y1 = map(_real, self.added.bbox)
        return x0, y0, x1, y1

    @property
    def pose(self) -> tuple[float, float, float] | None:
        """Metres and radians; None when the robot had no pose."""
        at = self.keyframe_pose
        return None if at is None else (at.x_um / UM_PER_M, at.y_um / UM_PER_M, at.yaw_rad)

    @property
    def camera(self) -> CameraValues | None:
        """The camera that the envelope states; None where it states none."""
        return None if self.stated is None else camera_values(self.stated)

    @property
    def unit(self) -> UnitVector:
        """The embedding as a unit vector of the fold. Every row has one."""
        assert self.added.embedding is not None  # noqa: S101 - see `BatchChanges.embedded`
        return self.added.embedding

    @property
    def embedding(self) -> NDArray[np.float32]:
        """The embedding as stored in the table, shape (dim,)."""
        return to_float32(self.unit)

    @property
    def ingested_us(self) -> int:
        """µs since the epoch."""
        return self.logged_ns // 1000

    @property
    def ingested_at(self) -> datetime:
        """The same as a value of timestamptz."""
        return _EPOCH + timedelta(microseconds=self.ingested_us)


def new_rows(changes: BatchChanges, view: MapView) -> list[VectorRow]:
    """The rows that a batch adds, in the order of their observations."""
    made = ((added, view.keyframes[added.keyframe], ns) for added, ns in changes.embedded)
    return [VectorRow(added, keyframe.pose, keyframe.camera, ns) for added, keyframe, ns in made]


def _real(value: float) -> float:
    try:
        rounded: float = _REAL.unpack(_REAL.pack(value))[0]
    except OverflowError:
        return math.copysign(math.inf, value)
    return rounded
