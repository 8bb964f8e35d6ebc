"""Floors in what commands print and draw, and edits across floors."""

from pathlib import Path

import pytest

from eventsrc.envelope.model import Offset
from projections.edit import make as m
from projections.edit.conflicts import EditRefused
from projections.fold.settings import Settings
from projections.history import LogTimeline
from tests.property.test_floors import drive
from tests.support.commands import Commands
from tests.support.logs import make, write_log


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two floors, one above the other, and one without a name."""
    documents = drive({"floor": "ground"}, {"map_z": 3.1}, {})
    return write_log(tmp_path_factory.mktemp("floors") / "log", documents)


def test_state_says_which_floor_a_keyframe_and_a_place_is_on(mapfold: Commands, log: Path) -> None:
    document = mapfold("state", log, "--json").json
    assert document["floors"] == ["ground", "1"]
    assert [place.get("floor") for place in document["places"]] == ["ground", "1", None]
    assert [k.get("floor") for k in document["keyframes"]] == ["ground"] * 6 + ["1"] * 6 + [
        None
    ] * 6
    assert document["adjacency"] == [
        {"a": "run-a_p0", "b": "run-a_p1", "shared_transitions": 1, "between_floors": True},
        {"a": "run-a_p1", "b": "run-a_p2", "shared_transitions": 1, "between_floors": True},
    ]
    text = mapfold("state", log).out
    header, *rows = text.splitlines()[-4:]
    assert header.split()[:2] == ["place", "floor"]
    assert [row.split()[:2] for row in rows] == [
        ["p0", "ground"],
        ["p1", "1"],
        ["p2", "-"],
    ]


def test_the_height_of_a_floor_is_a_setting(mapfold: Commands, log: Path) -> None:
    document = mapfold("state", log, "--json", "--set", "floor_height_m=1.5").json
    assert document["floors"] == ["ground", "2"]
    assert document["settings"]["floor_height_m"] == 1.5
    said = mapfold("state", log, "--set", "floor_height_m=0.1", code=2).err
    assert "floor_height_m=0.1: input should be greater than or equal to 0.5" in said


def test_a_past_map_has_the_floors_until_then(mapfold: Commands, log: Path) -> None:
    assert mapfold("state", log, "--json", "--at", "6").json["floors"] == ["ground"]
    with LogTimeline(log, Settings()) as timeline:
        past = timeline.at(Offset(9))
    assert list(past.floors) == ["ground", "1"]
    assert [k.floor for k in past.keyframes] == ["ground"] * 6 + ["1"] * 3


def test_draw_shows_one_floor_or_says_that_it_shows_several(
    mapfold: Commands, log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "map.svg"
    assert (
        "shows 3 floors, one above the other; --floor NAME draws one"
        in mapfold("draw", log, "--out", out).err
    )
    for name in ("ground", "1", "-"):
        done = mapfold("draw", log, "--out", out, "--floor", name)
        assert "1 place, 1 object" in done.err
        text = out.read_text("utf-8")
        assert f"floor {name}" in text
        assert "6 keyframes (0 in no place)" in text
    said = mapfold("draw", log, "--out", out, "--floor", "2", code=2).err
    assert "no floor '2' in this map; it has ground, 1, -" in said


def test_what_is_on_two_floors_is_not_made_one(log: Path) -> None:
    with pytest.raises(EditRefused, match="are on two floors, 'ground' and '1'; nothing on two"):
        make(log, m.join, "run-a_p0", "run-a_p1")
    with pytest.raises(EditRefused, match="are on two floors, '1' and none"):
        make(log, m.same_object, "cup-1-0", "cup-2-0")
