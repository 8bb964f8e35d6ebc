"""One crop with all the ranking needs of it: its view, its landmarks, the poses behind them."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .camera import Camera, Floats, views
from .candidates import Match
from .landmarks import Landmark, find_landmarks
from .model import Model
from .question import Crop
from .sessions import Sessions, session_shifts, sessions_of, unshifted

_NEAREST_M, _FARTHEST_M = 0.5, 6.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A crop and its landmarks. ``poses`` of shape (n, 3) are those its landmarks' members index.

    ``bearing`` (radians, left positive) and ``depth`` (metres ahead) are None without a box;
    ``cut_x`` and ``cut_y`` say that the picture's edge cut the box, ``sigma_log_size`` how unsure
    the size is that depth and landmarks share.
    """

    landmarks: tuple[Landmark, ...]
    poses: Floats
    bearing: float | None
    depth: float
    cut_x: bool
    cut_y: bool
    sigma_log_size: float

    @property
    def in_robot_frame(self) -> tuple[float, float]:
        """Metres ahead and left of the robot; only for a crop with a box."""
        return self.depth, self.depth * math.tan(self.bearing or 0.0)


def sightings(
    crops: Sequence[Crop], matches: Sequence[Sequence[Match]], camera: Camera, model: Model
) -> tuple[Sighting, ...]:
    """Sightings of the crops that have a relevant match with a pose; maybe none."""
    shifts, found = session_shifts(matches, model), []
    for crop, row in zip(crops, matches, strict=True):
        relevant = [
            m
            for m in unshifted(row, shifts)
            if m.pose is not None and m.similarity > model.relevant
        ]
        if relevant:
            sessions = sessions_of(relevant, shifts, model)
            found.append(_sighting(crop, relevant, sessions, camera, model))
    return tuple(found)


def _sighting(
    crop: Crop, matches: Sequence[Match], sessions: Sessions, camera: Camera, model: Model
) -> Sighting:
    poses = np.array([m.pose for m in matches], dtype=np.float64)
    similarity = np.array([m.similarity for m in matches], dtype=np.float64)
    seen = views(camera, [m.bbox for m in matches])
    landmarks = find_landmarks(poses, seen, similarity, sessions, model)
    own = views(camera, [crop.bbox])
    known = bool(own.known[0])
    depth = landmarks.size / float(own.height_px[0])
    return Sighting(
        landmarks.items,
        poses,
        math.atan(float(own.slope[0])) if known else None,
        min(max(depth, _NEAREST_M), _FARTHEST_M),
        bool(own.cut_x[0]),
        bool(own.cut_y[0]),
        landmarks.sigma_log_size,
    )
