"""The map's embedding space, which decides which vectors are compared, and vectors of that space
that ``reembed`` commands added to detections."""

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import DetId

from .exact import Units, unit_vectors
from .settings import Settings


class Space:
    """The map's embedding space, a model and a dimension; open until it is decided.

    Parts that the settings leave open are fixed by the first embedded detection that matches the
    settings. A vector of another space is *foreign*: it is counted, but neither fused nor searched.
    A detection that names no model is of the unnamed model, which is a model like any other.
    """

    def __init__(self, settings: Settings) -> None:
        self._wanted_model = settings.embedding_model
        self._wanted_dim = settings.embedding_dim
        self.is_decided = False
        self.model: str | None = None
        self.dim = 0

    def decide(self, model: str | None, dim: int) -> None:
        """Fix the space."""
        self.is_decided, self.model, self.dim = True, model, dim

    def has(self, model: str | None, dim: int) -> bool:
        """Whether vectors of this model and dimension are in the map; the first one fixes an open
        space."""
        if model == self.model and dim == self.dim:
            return True
        if not self.is_decided:
            if self._wanted_model not in (None, model) or self._wanted_dim not in (None, dim):
                return False
            self.decide(model, dim)
            return True
        return False


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
        """The envelope and its ``units``, with the vectors of this space added to its
        detections."""
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
            detections[i] = replace(detections[i], embedding_model=self.space)
            vectors[i], changed[i] = given[i], unit
        edited = replace(envelope, detections=tuple(detections))
        return Accepted(edited, accepted.det_ids, tuple(vectors)), changed
