"""Vectors that detections were given later, of the space that a map names."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope import DetId
from eventsrc.ingest import Accepted
from projections.exact import Units, unit_vectors


class Reembedded:
    """Vectors of one space by det_id, float32. The map is that of a log in which they were recorded
    with their detections; a detection that has a vector of the space keeps its own."""

    def __init__(self, space: str, vectors: dict[DetId, NDArray[np.float32]]) -> None:
        self.space = space
        self._vectors = vectors

    def __contains__(self, det_id: DetId) -> bool:
        return det_id in self._vectors

    def applied(
        self, accepted: Accepted, units: Sequence[Units | None]
    ) -> tuple[Accepted, Sequence[Units | None]]:
        """An envelope, and ``units`` of its vectors, with what is known of its detections."""
        envelope, rows = accepted.envelope, self._vectors
        models = [detection.embedding_model for detection in envelope.detections]
        given = {
            i: rows[det_id]
            for i, (det_id, own) in enumerate(zip(accepted.det_ids, accepted.vectors, strict=True))
            if det_id in rows and (own is None or models[i] != self.space)
        }
        if not given:
            return accepted, units
        detections, vectors = list(envelope.detections), list(accepted.vectors)
        changed = list(units)
        for i, unit in zip(given, unit_vectors(list(given.values())), strict=True):
            detections[i] = detections[i].model_copy(update={"embedding_model": self.space})
            vectors[i], changed[i] = given[i], unit
        edited = envelope.model_copy(update={"detections": tuple(detections)})
        return Accepted(edited, accepted.det_ids, tuple(vectors)), changed
