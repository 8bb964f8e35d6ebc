"""Types of places in commands and databases: state, query, draw, names, a live tail."""

import json
from pathlib import Path
from typing import Any

import pytest

from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from tests.integration.test_projections import parsed
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log
from tests.support.rows import expected_graph, graph_rows
from tests.support.thorough import mostly_slow

LOOKS = {
    "refrigerator": [1, 0, 0, 0],
    "sink": [0, 1, 0, 0],
    "toilet": [0, 0, 1, 0],
    "box": [1, 1, 1, 1],
}


def room(first: int, x: float, classes: list[str]) -> list[dict[str, Any]]:
    """Four poses in a room that all show the same things."""
    return [
        envelope(first + k, x + 0.1 * k, 0.0, detections=[detection(c, LOOKS[c]) for c in classes])
        for k in range(4)
    ]


DOCUMENTS = [
    *room(0, 0.0, ["refrigerator", "sink"]),
    *room(10, 9.0, ["toilet", "sink"]),
    *room(20, 18.0, ["box"]),
    *room(30, 27.0, []),
]
KITCHEN, BATHROOM, SHED, EMPTY = (f"run-a_p{n}" for n in range(4))


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", DOCUMENTS)


def types(mapfold: Commands, log: Path) -> dict[str, Any]:
    places = mapfold("state", log, "--json").json["places"]
    return {place["place_id"]: place.get("type", "nothing") for place in places}


def test_state_says_what_kind_of_room_a_place_is(mapfold: Commands, log: Path) -> None:
    assert types(mapfold, log) == {
        KITCHEN: "kitchen",
        BATHROOM: "bathroom",
        SHED: None,
        EMPTY: "nothing",
    }
    kitchen = mapfold("state", log, "--json").json["places"][0]
    assert kitchen["type_probability"] == kitchen["type_candidates"][0]["probability"] > 0.5
    rows = mapfold("state", log).out.splitlines()[-5:]
    assert rows[0].split()[:2] == ["place", "type"]
    assert rows[1].split()[1] == "kitchen"
    assert rows[1].split()[3] == "%"
    assert rows[3].split()[1] == "4", "unsure: the next column is the number of keyframes"


def test_a_name_overrides_the_type(mapfold: Commands, log: Path) -> None:
    mapfold("edit", log, "name-place", SHED, "west storage", "--reason", "boxes")
    mapfold("edit", log, "name-place", BATHROOM, "laundry room", "--reason", "a washing place")
    mapfold("edit", log, "name-place", KITCHEN, "Anna's", "--reason", "says no type")
    assert types(mapfold, log) == {
        KITCHEN: "kitchen",
        BATHROOM: "laundry room",
        SHED: "storage room",
        EMPTY: "nothing",
    }
    place = mapfold("state", log, "--json").json["places"][1]
    assert place["type_probability"] == 1.0


@pytest.mark.slow
def test_room_finds_a_place_by_type_and_by_name(mapfold: Commands, log: Path) -> None:
    def room(what: str) -> Any:
        return mapfold("room", log, what, "--json").json

    found = room("kitchen")
    assert (found["place_id"], found["type"]) == (KITCHEN, "kitchen")
    mapfold("edit", log, "name-place", SHED, "Anna's kitchen", "--reason", "so she says")
    assert room("Anna's kitchen")["place_id"] == SHED
    assert "'kitchen' means 2 places" in mapfold("room", log, "kitchen", code=2).err
    assert room("wc")["place_id"] == BATHROOM
    said = mapfold("room", log, "office", code=2).err
    assert "no place 'office' under these settings; there are " in said
    said = mapfold("room", log, "bathrom", code=2).err
    assert "near it: bathroom" in said


@pytest.mark.slow
def test_the_picture_shows_types(mapfold: Commands, log: Path, tmp_path: Path) -> None:
    out = tmp_path / "map.svg"
    mapfold("draw", log, "--out", out)
    text = out.read_text("utf-8")
    assert "kitchen?" in text
    assert "bathroom?" in text
    mapfold("edit", log, "name-place", BATHROOM, "the blue bathroom", "--reason", "its tiles")
    mapfold("draw", log, "--out", out)
    assert "bathroom?" not in out.read_text("utf-8")


@pytest.mark.parametrize("places", mostly_slow(["page", "rooms"]))
def test_a_live_tail_keeps_types_up_to_date(
    tmp_path: Path, one_database: Targets, places: Any
) -> None:
    settings, log = Settings(places=places), tmp_path / "live"
    for end in (2, 4, 6, 9, 16):
        write_log(log, DOCUMENTS[end - 2 if end < 9 else (6 if end == 9 else 9) : end])
        tail(log, one_database, settings, once=True, batch_events=1)
        found = parsed(graph_rows(one_database.graph_url))
        view = view_of(log, settings)
        assert found == expected_graph(view)
    assert sorted(row[1].get("type", "") for row in found["Place"])[-2:] == ["bathroom", "kitchen"]
    assert all(report.sound for report in check(log, one_database, settings))
    before = graph_rows(one_database.graph_url)
    rebuild(log, one_database, settings)
    assert graph_rows(one_database.graph_url) == before


def view_of(log: Path, settings: Settings) -> Any:
    from eventsrc.log import LogReader
    from projections.map.fold import fold_log

    with LogReader(log) as reader:
        return fold_log(reader, settings)[1]


@pytest.mark.slow
def test_the_live_map_answers_where_the_kitchen_is(
    mapfold: Commands, log: Path, one_database: Targets
) -> None:
    rebuild(log, one_database, Settings())
    live = mapfold("room", "kitchen", "--json", "--db", one_database.graph_url).json
    assert live == mapfold("room", log, "kitchen", "--json").json
    assert json.dumps(live)
