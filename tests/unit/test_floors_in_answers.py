"""Re-localisation in a building with floors: the answer is on one of them and names it."""

from typing import Any

import pytest

from projections.localize.relocalize import parse_question, rank
from projections.localize.relocalize.candidates import ExactIndex
from projections.localize.relocalize.ranking import Answer, Method
from projections.map.view import MapView
from projections.surfaces.cli.relocalize import answer_text
from tests.support.envelopes import detection, envelope, payload
from tests.support.folds import fold

LOOKS = {
    ("ground", "chair"): [1.0, 0.0, 0.0, 0.2],
    ("ground", "lamp"): [0.0, 1.0, 0.0, 0.2],
    ("1", "chair"): [0.75, 0.0, 0.66, 0.0],
    ("1", "lamp"): [0.0, 0.75, 0.66, 0.0],
}


def building(floors: dict[str, dict[str, Any]]) -> MapView:
    """A drive along a corridor on each floor; a chair and a lamp stand at its end, which look much
    alike from floor to floor."""
    documents = []
    for number, (name, floor) in enumerate(floors.items()):
        for k in range(8):
            far = 5.0 - 0.5 * k
            seen = []
            for index, what in enumerate(("chair", "lamp")):
                middle, half = 220.0 + 200.0 * index, 40.0 / far * 2.0
                box = [middle - half, 200.0 - half, middle + half, 200.0 + half]
                seen.append(detection(what, LOOKS[name, what], bbox=box))
            documents.append(
                envelope(
                    10 * number + k, 0.5 * k, 3.0, run_id=f"run-{name}", detections=seen, **floor
                )
            )
    return fold(documents, fusion_similarity=0.95).view


def ask(view: MapView, floor: str, method: Method = "joint") -> Answer:
    crops = [
        detection(what, look, bbox=[180.0 + 200.0 * i, 160.0, 260.0 + 200.0 * i, 240.0])
        for i, ((name, what), look) in enumerate(LOOKS.items())
        if name == floor
    ]
    question = parse_question(payload(crops))
    return rank(
        question, ExactIndex(view).search(getattr(question, "crops", question)), method=method
    )


FLOORS = {"ground": {"floor": "ground"}, "1": {"map_z": 3.0}}


@pytest.mark.parametrize("method", ["joint", "plain"])
@pytest.mark.parametrize("floor", ["ground", "1"])
def test_the_answer_names_the_floor_that_the_crops_are_of(floor: str, method: Method) -> None:
    answer = ask(building(FLOORS), floor, method)
    best = answer.places[0]
    assert (best.place_id, best.floor) == (f"run-{floor}_p0", floor)
    assert answer.pose is not None
    assert answer.pose.floor == floor
    assert -3.0 < answer.pose.x < 6.0
    assert answer.pose.spread_m < 10.0
    document = answer.document()
    assert document["pose"]["floor"] == document["places"][0]["floor"] == floor
    text = answer_text(answer)
    assert f"run-{floor}_p0 on floor {floor}" in text
    assert f"m on floor {floor}, " in text


@pytest.mark.parametrize("method", ["joint", "plain"])
def test_one_floor_answers_as_a_map_without_floors_does(method: Method) -> None:
    plain = ask(building({"ground": {}}), "ground", method).document()
    named = ask(building({"ground": {"floor": "ground"}}), "ground", method).document()
    assert "floor" not in plain["pose"]
    assert "floor" not in plain["places"][0]
    assert named["pose"].pop("floor") == named["places"][0].pop("floor") == "ground"
    assert named == plain


def test_a_floor_without_a_name_is_one_too() -> None:
    answer = ask(building({"ground": {}, "1": {"floor": 1}}), "ground")
    assert answer.pose is not None
    assert answer.pose.floor is None
    assert answer.pose.x < 6.0
    assert answer.places[0].floor is None
