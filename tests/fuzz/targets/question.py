"""A question to the service or the command: crops, or QuestionError."""

import random
from collections.abc import Sequence

import numpy as np

from projections.errors import QuestionError
from projections.relocalize import parse_question
from tests.attack.corruption import corrupt_json
from tests.envelopes import detection, envelope, payload
from tests.fuzz.target import Target, check_message


class QuestionTarget(Target):
    """The bytes of a question."""

    def seeds(self) -> Sequence[bytes]:
        """All three forms, with both forms of an embedding."""
        crop = detection("cup", [1.0, 2.0, 3.0], det_id="d")
        plain = {"class": "cup", "bbox": [1, 2, 3, 4], "embedding": [0.5, 0.25, -1.0]}
        document = {"crops": [crop, plain], "top": 3, "method": "joint"}
        return [payload(d) for d in (document, [crop], [plain], envelope(1, detections=[crop]))]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One value becomes another."""
        return corrupt_json(data, rng)

    def check(self, data: bytes) -> None:
        """Unit vectors of one dimension, or a short refusal."""
        try:
            crops = parse_question(data)
        except QuestionError as error:
            check_message(error)
            return
        assert len({len(crop.vector) for crop in crops}) == 1
        for crop in crops:
            assert np.isfinite(crop.vector).all()
