"""A question to the service or the command: crops, or QuestionError."""

import random
from collections.abc import Sequence

import numpy as np

from projections.fold.map_errors import QuestionError
from projections.localize.relocalize import parse_question
from projections.localize.relocalize.question import MAX_VIEWS
from scripts.programs.attack.corruption import corrupt_json
from scripts.programs.fuzz.target import Target, check_message
from tests.support.envelopes import detection, envelope, payload

CAMERA = {"hfov_deg": 90.0, "width_px": 640, "height_px": 480}


class QuestionTarget(Target):
    """The bytes of a question."""

    def seeds(self) -> Sequence[bytes]:
        """All forms, with both forms of an embedding."""
        crop = detection("cup", [1.0, 2.0, 3.0], det_id="d")
        plain = {"class": "cup", "bbox": [1, 2, 3, 4], "embedding": [0.5, 0.25, -1.0]}
        document = {"crops": [crop, plain], "top": 3, "method": "joint"}
        moved = {"dx": 0.5, "dy": -0.25, "dyaw": 1.5, "crops": [plain, {"class": "mirror"}]}
        views = {"views": [{"crops": [crop]}, moved], "camera": CAMERA}
        text = {"crops": [{"class": "cup", "embedding": [1.0, 0.0, 0.0], "text": True}]}
        pictures = envelope(1, detections=[crop])
        return [payload(d) for d in (document, [crop], [plain], pictures, views, text)]

    def mutate(self, data: bytes, rng: random.Random) -> bytes:
        """One value becomes another."""
        return corrupt_json(data, rng)

    def check(self, data: bytes) -> None:
        """Unit vectors of one dimension or classes, finite movements, or a short refusal."""
        try:
            question = parse_question(data)
        except QuestionError as error:
            check_message(error)
            return
        assert question.crops
        assert len(question.views) <= MAX_VIEWS
        vectors = [crop.vector for crop in question.crops if crop.vector is not None]
        assert len({len(vector) for vector in vectors}) <= 1
        assert all(np.isfinite(vector).all() for vector in vectors)
        assert all(c.class_name is not None for c in question.crops if c.vector is None)
        for view in question.views:
            assert np.isfinite([view.dx, view.dy, view.dyaw]).all()
