"""Two robots with two cameras in one map: boxes are read by the camera that took each picture."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any

import pytest

from eventsrc.envelope.ingest import Accepted, ingest
from projections.localize.evaluate.questions import make_questions
from projections.localize.evaluate.trials import TrialRunner
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from projections.map.view import MapView
from tests.support.envelopes import payload
from tests.support.folds import fold
from tests.support.seen_rooms import CAMERA, drive
from tests.support.thorough import mostly_slow

NARROW = {"hfov_deg": 50.0, "width_px": 320.0, "height_px": 240.0, "yaw_rad": 1.2}
"""Of a robot that looks to its left."""
CAMERAS = {"wide": CAMERA, "narrow": NARROW}
SEED, COUNT = 4, 60


def run(run_id: str, by: str, count: int = COUNT) -> list[dict[str, Any]]:
    return drive(SEED, run_id, count, by=CAMERAS[by])


def questions_of(by: str) -> list[dict[str, Any]]:
    return run(f"asks-{by}", by, 40)


def median_error_m(view: MapView, documents: Sequence[Mapping[str, Any]]) -> float:
    """Of questions of one crop from each keyframe, whose truth is its pose."""
    asking = list(_accepted(documents))
    truth = Truth(
        {
            (d["run_id"], d["keyframe_id"]): TrueKeyframe(
                run_id=d["run_id"],
                keyframe_id=d["keyframe_id"],
                room=None,
                instances=[each["class"] for each in d["detections"]],
            )
            for d in documents
        }
    )
    runner = TrialRunner(view, truth, camera=None, method="joint")
    errors = [trial.pose_error_m for trial in runner.run(make_questions(asking, truth, 1))]
    assert len(errors) > 10
    return median(each for each in errors if each is not None)


def _accepted(documents: Sequence[Mapping[str, Any]]) -> Iterator[Accepted]:
    for document in documents:
        found = ingest(payload(document), max_bytes=1 << 24)
        assert isinstance(found, Accepted)
        yield found


@pytest.mark.parametrize("fusion", mostly_slow(["evidence", "page"]))
def test_a_map_of_two_cameras_answers_each_as_a_map_of_its_own_does(fusion: str) -> None:
    both = fold([*run("a", "wide"), *run("b", "narrow")], fusion=fusion).view
    for by in CAMERAS:
        alone = fold([*run("a", by), *run("b", by)], fusion=fusion, camera=CAMERAS[by]).view
        asked = questions_of(by)
        assert median_error_m(both, asked) < 1.1 * median_error_m(alone, asked)


def test_a_question_without_a_camera_is_read_by_that_of_what_it_finds() -> None:
    view = fold([*run("a", "narrow"), *run("b", "narrow")], fusion="evidence").view
    asked = questions_of("narrow")
    silent = [{k: v for k, v in each.items() if k != "camera"} for each in asked]
    assert median_error_m(view, silent) == median_error_m(view, asked)
