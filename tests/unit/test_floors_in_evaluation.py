"""The evaluation of a building with floors: an answer on another floor is wrong."""

import math
from typing import Any

import pytest

from eventsrc.envelope.ingest import Accepted, ingest_all
from projections.localize.evaluate.questions import make_questions
from projections.localize.evaluate.scores import percentiles, place_scores
from projections.localize.evaluate.trials import RoomIndex, Trial, TrialRunner
from projections.localize.evaluate.truth import TrueKeyframe, Truth
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope, payload
from tests.support.folds import fold

LOOKS = {"ground": [1.0, 0.0, 0.0], "1": [0.0, 1.0, 0.0]}
FLOORS: dict[str, dict[str, Any]] = {"ground": {"floor": "ground"}, "1": {"map_z": 3.2}}


def drive(floor: str, run_id: str, look: list[float]) -> list[dict[str, Any]]:
    """Towards a thing with this look, which stands 5 m ahead of the first keyframe."""
    found = []
    for k in range(6):
        half = 80.0 / (5.0 - 0.5 * k)
        seen = detection("lamp", look, bbox=[320 - half, 200 - half, 320 + half, 200 + half])
        fields = {"run_id": run_id, "detections": [seen], **FLOORS[floor]}
        found.append(envelope(k, 0.5 * k, 3.0, map_yaw=0.0, **fields))
    return found


def accepted(documents: list[dict[str, Any]]) -> list[Accepted]:
    return [each for each in ingest_all([*map(payload, documents)]) if isinstance(each, Accepted)]


MAPPED = [*drive("ground", "a", LOOKS["ground"]), *drive("1", "b", LOOKS["1"])]


@pytest.fixture(scope="module")
def view() -> MapView:
    return fold(MAPPED, fusion_similarity=0.95).view


def truth_of(documents: list[dict[str, Any]], floor: str) -> Truth:
    lines = [
        TrueKeyframe(
            run_id=each["run_id"],
            keyframe_id=each["keyframe_id"],
            room=f"hall {floor}",
            instances=[f"lamp {floor}"],
        )
        for each in documents
    ]
    return Truth({(line.run_id, line.keyframe_id): line for line in lines})


def trials(view: MapView, floor: str, look: str) -> list[Trial]:
    """Asked from a floor with the look of the thing on another, or on the same one."""
    asking = drive(floor, "asks", LOOKS[look])
    below, above = truth_of(MAPPED[:6], "ground"), truth_of(MAPPED[6:], "1")
    known = (below.keyframes, above.keyframes, truth_of(asking, floor).keyframes)
    truth = Truth({key: line for lines in known for key, line in lines.items()})
    rooms = RoomIndex(accepted(MAPPED), accepted(asking), truth)
    runner = TrialRunner(view, truth, camera=None, method="joint", room_index=rooms)
    return runner.run(make_questions(accepted(asking), truth, 1))


@pytest.mark.parametrize("floor", FLOORS)
def test_an_answer_on_the_floor_of_the_question_is_scored_as_without_floors(
    view: MapView, floor: str
) -> None:
    for trial in trials(view, floor, floor):
        assert (trial.question.floor, trial.wrong_floor) == (floor, False)
        assert trial.pose_error_m is not None
        assert trial.pose_error_m < 10.0
        assert trial.plain_error_m is not None
        assert trial.plain_error_m < 10.0
        assert trial.room_of_pose == trial.room_at_pose == f"hall {floor}"


def test_an_answer_on_another_floor_is_wrong_however_near_in_the_plane(view: MapView) -> None:
    found = trials(view, "1", "ground")
    assert found
    for trial in found:
        assert trial.wrong_floor
        assert not trial.correct
        assert trial.pose_error_m == trial.plain_error_m == trial.centroid_error_m == math.inf
        assert trial.room_of_pose == trial.room_at_pose == "hall ground"
        assert trial.nearest_place is False
    assert percentiles(trial.pose_error_m for trial in found) == {"p50": None, "p90": None}
    assert percentiles([1.0, 2.0, math.inf]) == {"p50": 2.0, "p90": None}


def test_places_without_rooms_in_the_truth_have_no_scores(view: MapView) -> None:
    unknown = {
        (each["run_id"], each["keyframe_id"]): TrueKeyframe(
            run_id=each["run_id"], keyframe_id=each["keyframe_id"], room=None, instances=["lamp"]
        )
        for each in MAPPED
    }
    scores = place_scores(view, Truth(unknown))
    assert (scores["number"], scores["rooms"]) == (2, 0)
    assert scores["v_measure"] is scores["homogeneity"] is scores["adjusted_rand"] is None
