"""A robot that sends crops gets the places where those things stand, whatever their names are."""

import json
from pathlib import Path

import pytest

from tests.acceptance.awkward_run import CLASSES, ROOMS, awkward_payloads
from tests.support.commands import Commands


@pytest.fixture(scope="module", autouse=True)
def replayed(mapfold: Commands, awkward_log: Path) -> None:
    """The databases hold the awkward run."""
    mapfold("replay", awkward_log)


@pytest.mark.parametrize("room", range(len(ROOMS)))
def test_a_crop_leads_to_the_room_it_was_taken_in(mapfold: Commands, room: int) -> None:
    question = mapfold.folder / f"question-{room}.json"
    question.write_bytes(awkward_payloads()[4 * room + 1])
    answer = mapfold("relocalize", question, "--top", "3", "--json").json
    best = answer["places"][0]
    x, y = ROOMS[room]
    assert best["centroid_x"] == pytest.approx(x + 0.45, abs=0.1)
    assert best["centroid_y"] == pytest.approx(y, abs=0.1)
    assert {e["class_name"] for e in best["evidence"]} == {CLASSES[room]}
    assert len(answer["places"]) <= 3
    assert 0.0 <= answer["confidence"] <= 1.0


def test_a_question_may_come_on_stdin(mapfold: Commands) -> None:
    said = mapfold("relocalize", "-", "--json", stdin=awkward_payloads()[0])
    assert said.json["places"]


@pytest.mark.parametrize(
    "question", [b"nonsense", b"{}", json.dumps({"detections": []}).encode()], ids=repr
)
def test_a_question_without_crops_is_refused_in_one_line(
    mapfold: Commands, question: bytes
) -> None:
    said = mapfold("relocalize", "-", stdin=question, code=2)
    assert len(said.err.strip().splitlines()) == 1
