"""The observations of a folded map as columns: pose, direction, class, box and look of each.

All constants are estimated from `Sightings`. Cosines of looks are exact: unit vectors are whole
multiples of 2⁻²⁰ (`projections.fold.exact`), so a product of two does not depend on the machine.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from projections.fold.deltas import Pose
from projections.fold.exact import Q40, UnitVector
from projections.fold.settings import CameraConstants
from projections.localize.relocalize.camera import Cameras, box_rows, camera_values, views

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
_BEYOND_PX = 2.0
"""Most pixels that a box may reach beyond the picture; more means another camera."""


class Row(NamedTuple):
    """One observation that was fused. ``picture`` and ``run`` are numbers of keyframe
    and run, ``thing`` that of the Object it was fused into."""

    picture: int
    run: int
    pose: Pose
    camera: CameraConstants
    class_name: str
    bbox: tuple[float, float, float, float]
    look: UnitVector | None
    thing: int


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Columns of equal length, one entry an observation, in the order of the fold.

    ``sight`` is the direction from the robot to the thing in the map frame, ``off_axis`` its angle
    from the picture's axis, left positive, radians. ``height`` is the box's height divided by the
    focal length, NaN where the picture's border cuts it at top or bottom. ``boxed`` is False where
    the box is empty: nothing is known of its direction then, ``looked`` where there is no
    embedding. ``beyond`` counts the boxes that reach
    beyond the picture.
    """

    picture: Ints
    run: Ints
    x: Floats
    y: Floats
    heading: Floats
    sight: Floats
    off_axis: Floats
    cut: Flags
    height: Floats
    boxed: Flags
    classes: Sequence[str]
    thing: Ints
    looks: Sequence[UnitVector | None]
    looked: Flags
    beyond: int

    def __len__(self) -> int:
        return len(self.picture)

    def cosines(self, a: Ints, b: Ints) -> Floats:
        """The cosine of each pair of observations, all of which have a look."""
        found = np.empty(len(a))
        for start in range(0, len(a), _PAIRS_AT_ONCE):
            part = slice(start, start + _PAIRS_AT_ONCE)
            left = np.array([self.looks[i] for i in a[part]], dtype=np.float64)
            right = np.array([self.looks[i] for i in b[part]], dtype=np.float64)
            found[part] = np.einsum("ij,ij->i", left, right) / Q40
        return found


_PAIRS_AT_ONCE = 4096


def sightings_of(rows: Iterable[Row]) -> Sightings:
    """The columns of observations."""
    rows = list(rows)
    boxes = box_rows([row.bbox for row in rows])
    cameras = Cameras.of([camera_values(row.camera) for row in rows])
    read = views(cameras, boxes)
    off_axis, whole = np.arctan(read.slope), read.known & ~read.cut_y
    x0, y0, x1, y1 = boxes.T
    beyond = (np.minimum(x0, y0) < -_BEYOND_PX) | (x1 > cameras.width_px + _BEYOND_PX)
    beyond |= y1 > cameras.height_px + _BEYOND_PX
    heading = np.array([row.pose.yaw_rad for row in rows], dtype=np.float64)
    return Sightings(
        picture=np.array([row.picture for row in rows], dtype=np.int64),
        run=np.array([row.run for row in rows], dtype=np.int64),
        x=np.array([row.pose.x_m for row in rows], dtype=np.float64),
        y=np.array([row.pose.y_m for row in rows], dtype=np.float64),
        heading=heading,
        sight=heading + cameras.yaw_rad + off_axis,
        off_axis=off_axis,
        cut=read.cut_x,
        height=np.where(whole, read.height_px / cameras.focal_px, np.nan),
        boxed=read.known,
        classes=[row.class_name for row in rows],
        thing=np.array([row.thing for row in rows], dtype=np.int64),
        looks=[row.look for row in rows],
        looked=np.array([row.look is not None for row in rows], dtype=np.bool_),
        beyond=int(beyond.sum()),
    )
