"""`mapfold query`: live answers equal those of the folded log, with any names."""

import json
from datetime import datetime
from pathlib import Path

import pytest

from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.view import MapView
from projections.postgres import rebuild
from projections.postgres.connection import Targets, connect
from projections.postgres.queries.candidate_search import prepare_graph
from projections.postgres.queries.map_queries import (
    FoldedMap,
    LiveMap,
    MapSource,
    objects_of,
    path_between,
    places_holding,
    where_is,
)
from tests.support.commands import Commands
from tests.support.logs import walk, write_log


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", walk(80, seed=5))


@pytest.fixture
def view(log: Path) -> MapView:
    with LogReader(log) as reader:
        return fold_log(reader, Settings())[1]


def test_live_answers_equal_those_of_the_folded_map(
    log: Path, view: MapView, one_database: Targets
) -> None:
    rebuild(log, one_database, Settings())
    folded: MapSource = FoldedMap(view)
    with connect(one_database.graph_url, autocommit=True) as connection:
        prepare_graph(connection)
        live = LiveMap(connection)
        for thing in view.objects.values():
            ours, theirs = where_is(live, thing.object_id), where_is(folded, thing.object_id)
            assert list(ours.items()) == list(theirs.items())  # the order of the columns too
        places = [p.place_id for p in view.places.values()]
        assert len(places) > 1
        for place in places:
            assert [[*o.items()] for o in objects_of(live, place)] == [
                [*o.items()] for o in objects_of(folded, place)
            ]
            assert path_between(live, places[0], place) == path_between(folded, places[0], place)
            for name in sorted({o.class_name for o in view.objects.values()}):
                assert places_holding(live, name, place, 1) == places_holding(
                    folded, name, place, 1
                )
        assert where_is(live, view.objects[0].object_id)["place_id"] in [*places, None]


def test_the_command_asks_a_past_map(tmp_path: Path, log: Path, view: MapView) -> None:
    mapfold = Commands.in_folder(tmp_path)
    thing = view.objects[0]
    now = mapfold("query", "where", thing.object_id, "--log", log, "--json").json
    assert now["obs_count"] == thing.obs_count
    assert now["first_seen"] == thing.first_seen
    assert datetime.fromisoformat(now["first_seen_iso"]).timestamp() == thing.first_seen
    text = mapfold("query", "where", thing.object_id, "--log", log).out
    assert f"first_seen {now['first_seen_iso']}  last_seen {now['last_seen_iso']}" in text
    first = next(k.offset for k in view.keyframes if thing.observations[0] in list(k.observations))
    then = mapfold(
        "query", "where", thing.object_id, "--log", log, "--at", str(first + 1), "--json"
    )
    assert then.json["obs_count"] == 1
    gone = mapfold("query", "where", thing.object_id, "--log", log, "--at", "0", code=2)
    assert thing.object_id in gone.err
    refused = mapfold("query", "where", thing.object_id, "--at", "0", code=2)
    assert "--log" in refused.err


def test_a_past_map_is_folded_with_the_settings_given(tmp_path: Path, log: Path) -> None:
    wide = Settings.model_validate({"eps_m": 20.0})
    with LogReader(log) as reader:
        place = next(iter(fold_log(reader, wide)[1].places.values())).place_id
    mapfold = Commands.in_folder(tmp_path)
    asked = ("query", "contents", place, "--json", "--log", log)
    plain, given = mapfold(*asked), mapfold(*asked, "--set", "eps_m=20.0")
    assert len(given.json) > len(plain.json) > 0
    assert "default settings" in plain.err
    assert "default settings" not in given.err
    file = tmp_path / "settings.json"
    file.write_text(json.dumps({"eps_m": 20.0}))
    assert mapfold(*asked, "--settings", file).json == given.json


@pytest.mark.parametrize("question", ["where", "contents"])
def test_settings_without_a_log_are_refused(tmp_path: Path, question: str) -> None:
    """The live map has its own; taking them and not using them would be a lie."""
    refused = Commands.in_folder(tmp_path)("query", question, "x", "--set", "eps_m=1.0", code=2)
    assert "--log LOG" in refused.err
    assert len(refused.err.strip().splitlines()) == 1


def test_similar_objects_live(tmp_path: Path, log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, Settings())
    question = tmp_path / "question.json"
    question.write_text(json.dumps(next(d for d in walk(80, seed=5) if d["detections"])))
    mapfold = Commands.in_folder(tmp_path, MAPFOLD_DB=one_database.graph_url)
    found = mapfold("query", "similar", question, "--top", "3", "--json").json
    assert 1 <= len(found) <= 3
    assert found[0]["similarity"] == pytest.approx(1.0, abs=1e-5)
    assert [o["similarity"] for o in found] == sorted(
        (o["similarity"] for o in found), reverse=True
    )
    assert mapfold("query", "similar", question).out
