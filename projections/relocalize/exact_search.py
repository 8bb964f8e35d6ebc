"""Candidates from a folded map by exact search, for ``--as-of`` and for tests.

Unit vectors are multiples of 2⁻²⁰ and multiplied in float64, so every sum is exact whatever BLAS
does (see `projections.exact`): the same map and crops give the same candidates to the last bit.

The same question to a past map: the log folded to a point, searched exactly.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eventsrc.log import LogReader
from eventsrc.log.seek import Note, resolve
from eventsrc.text import counted
from projections.errors import QuestionError
from projections.exact import Q40, quantise
from projections.model.fold import fold_log
from projections.model.view import MapView
from projections.settings import Settings

from .answer import Answer
from .camera import Camera
from .candidates import NEIGHBOURS, Candidates, Match, Spot
from .question import Crop
from .ranking import DEFAULT_CAMERA, Method, rank


class ExactIndex:
    """The searchable observations of a view, as one matrix; made once, asked often."""

    def __init__(self, view: MapView) -> None:
        self._view = view
        rows = [o.ordinal for o in view.observations if o.embedding is not None]
        self._ordinals = np.array(rows, dtype=np.intp)
        vectors = [view.observations[ordinal].embedding for ordinal in rows]
        self._matrix = np.array(vectors, dtype=np.float64)
        self.places = {
            place.ordinal: Spot(place.place_id, place.centroid_x, place.centroid_y)
            for place in view.places.values()
        }
        self.model = next(
            (o.embedding_model for o in view.observations if o.embedding is not None), None
        )

    def search(self, crops: Sequence[Crop], neighbours: int = NEIGHBOURS) -> Candidates:
        """The nearest observations of each crop. Raises QuestionError for another space."""
        if not len(self._ordinals):
            return Candidates(tuple(() for _ in crops), self.places)
        for crop in crops:
            check_space(crop, self._matrix.shape[1], self.model)
        return Candidates(tuple(self._nearest(crop, neighbours) for crop in crops), self.places)

    def _nearest(self, crop: Crop, neighbours: int) -> tuple[Match, ...]:
        products = self._matrix @ quantise(crop.vector).astype(np.float64)
        order = np.argsort(-products, kind="stable")[:neighbours]
        return tuple(self._match(int(self._ordinals[i]), float(products[i]) / Q40) for i in order)

    def _match(self, ordinal: int, similarity: float) -> Match:
        seen = self._view.observations[ordinal]
        keyframe = self._view.keyframes[seen.keyframe]
        found = None if seen.object is None else self._view.objects[seen.object]
        pose = keyframe.pose
        return Match(
            ordinal,
            seen.det_id,
            keyframe.run_id,
            similarity,
            None if pose is None else (pose.x_um / 1e6, pose.y_um / 1e6, pose.yaw_rad),
            seen.bbox,
            seen.class_name if found is None else found.class_name,
            None if found is None else found.object_id,
            None if found is None else found.place,
            keyframe.place,
        )


def check_space(crop: Crop, dimension: int, model: str | None) -> None:
    """Raise QuestionError when the crop is not of the map's embedding space."""
    if len(crop.vector) != dimension:
        raise QuestionError(
            f"the question's embeddings have {counted(len(crop.vector), 'dimension')}, the"
            f" map's {dimension}; ask with the model that made the map ({model})"
        )
    if crop.model is not None and model is not None and crop.model != model:
        raise QuestionError(
            f"the question's embeddings are of model {crop.model!r}, the map's of {model!r};"
            " ask with the model that made the map"
        )


def relocalize_as_of(
    log: Path,
    whence: str,
    settings: Settings,
    crops: Sequence[Crop],
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera = DEFAULT_CAMERA,
    note: Note | None = None,
) -> Answer:
    """Where the robot is by the map as of ``whence``: offset, ISO time, run:keyframe or end.

    ``note`` is told what a reader of ``whence`` might wonder about (`eventsrc.log.seek.resolve`).
    """
    with LogReader(log) as reader:
        _, view = fold_log(reader, settings, resolve(reader, whence, note=note))
    candidates = ExactIndex(view).search(crops)
    return rank(crops, candidates, top=top, method=method, camera=camera)
