"""One map has one embedding space: a model and a dimension.

What the settings leave open, the first embedded detection that agrees with them decides. A vector
of another space is *foreign*: it is counted, but neither fused nor searched. A detection that names
no model is of the unnamed model, which is a model like any other.
"""

from collections.abc import Sequence

from eventsrc.envelope import Detection
from eventsrc.ingest import Vector
from projections.settings import Settings


class Space:
    """The map's embedding space; open until it is decided."""

    def __init__(self, settings: Settings) -> None:
        self._wanted_model = settings.embedding_model
        self._wanted_dim = settings.embedding_dim
        self.is_decided = False
        self.model: str | None = None
        self.dim = 0

    def decide(self, model: str | None, dim: int) -> None:
        """Fix the space."""
        self.is_decided, self.model, self.dim = True, model, dim

    def has(self, detection: Detection, vector: Vector) -> bool:
        """True when the detection's vector is of the map's space; the first one decides it."""
        model, dim = detection.embedding_model, len(vector)
        if not self.is_decided:
            if self._wanted_model not in (None, model) or self._wanted_dim not in (None, dim):
                return False
            self.decide(model, dim)
        return model == self.model and dim == self.dim

    def members(
        self, detections: Sequence[Detection], vectors: Sequence[Vector | None]
    ) -> list[Vector | None]:
        """``vectors`` with None in place of the foreign ones."""
        return [
            vector if vector is not None and self.has(detection, vector) else None
            for detection, vector in zip(detections, vectors, strict=True)
        ]
