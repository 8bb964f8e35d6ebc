"""The map's embedding space: which vectors are compared with each other."""

from projections.settings import Settings


class Space:
    """The map's embedding space, a model and a dimension; open until it is decided.

    What the settings leave open is decided by the first embedded detection that agrees with them. A
    vector of another space is *foreign*: it is counted, but neither fused nor searched. A detection
    that names no model is of the unnamed model, which is a model like any other.
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
        """True when a vector of this model and dimension is in the map; the first one decides."""
        if model == self.model and dim == self.dim:
            return True
        if not self.is_decided:
            if self._wanted_model not in (None, model) or self._wanted_dim not in (None, dim):
                return False
            self.decide(model, dim)
            return True
        return False
