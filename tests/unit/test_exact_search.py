"""Search in a folded log: similarities are cosines but for rounding, and none is above 1."""

import numpy as np
import pytest

from projections.fold.exact import to_float32
from projections.localize.relocalize import ExactIndex, QuestionCrop
from tests.support.folds import fold
from tests.support.logs import walk


def test_similarities_are_cosines_and_none_is_above_one() -> None:
    view = fold(walk(40, seed=4, detections=6)).view
    index = ExactIndex(view)
    vectors = [o.embedding for o in view.observations if o.embedding is not None]
    crops = [QuestionCrop(to_float32(vector)) for vector in vectors]
    for vector, matches in zip(vectors, index.search(crops, 5).matches, strict=True):
        own = vector.astype(np.float64)
        assert max(match.similarity for match in matches) <= 1.0
        for match in matches:
            found = view.observations[match.observation].embedding
            assert found is not None
            other = found.astype(np.float64)
            cosine = own @ other / np.linalg.norm(own) / np.linalg.norm(other)
            assert match.similarity == pytest.approx(cosine, abs=1e-5)
