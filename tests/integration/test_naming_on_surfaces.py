"""Places and objects by short ids, names, types of room and classes, wherever one is asked for."""

import re
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader
from projections.ask.find import Wanted, find
from projections.ask.room_and_path import path, room
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.naming import NoSuchThing, SeveralThings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.queries.candidate_search import prepare_graph
from projections.postgres.queries.live_view import read_view
from projections.surfaces.python import Timeline, fold
from tests.integration.test_types_of_places import BATHROOM, DOCUMENTS, KITCHEN, SHED
from tests.support.commands import Commands
from tests.support.logs import write_log


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", DOCUMENTS)


def test_why_takes_what_a_person_types(mapfold: Commands, log: Path) -> None:
    def why(text: str) -> Any:
        return mapfold("why", log, text, "--json").json["subject"]

    box = why("Box")
    assert [why(box), why(box[:10]), why(box[4:11])] == [box, box, box]
    assert [why("p1"), why("Bathroom"), why("wc")] == [BATHROOM, BATHROOM, BATHROOM]
    mapfold("edit", log, "name-place", "p2", "Anna's p1", "--reason", "hers")
    mapfold("edit", log, "name-place", "p0", "P2", "--reason", "a bad name")
    assert [why("anna's P1"), why("p1"), why("p2"), why(SHED)] == [SHED, BATHROOM, KITCHEN, SHED]
    said = mapfold("why", log, "sink", code=2).err
    assert "'sink' means 2 objects; give the id of one:\n  obj-" in said
    assert "(sink, in p0, seen 4 times at (" in said
    said = mapfold("why", log, "p7", code=2).err
    assert "no place or object 'p7' under these settings; near it: " in said
    assert "`mapfold state" in said
    said = mapfold("why", log, "run-a:3", code=2).err
    assert "run-a:3 is a keyframe, in p0" in said


def test_a_short_id_of_several_runs_lists_them(mapfold: Commands, log: Path) -> None:
    again = [{**each, "run_id": "run-b", "map_x": each["map_x"] + 90} for each in DOCUMENTS]
    for each in again:
        each["detections"] = []
    write_log(log.with_name("two"), [*DOCUMENTS, *again])
    said = mapfold("edit", "two", "join", "p1", "p0", "--dry-run", code=2).err
    assert "\n  run-a_p1 (bathroom, 4 keyframes at (9.15, 0.00))\n  run-b_p1 (" in said


@pytest.mark.slow
def test_every_printed_id_is_short_and_taken(mapfold: Commands, log: Path) -> None:
    document = mapfold("state", log, "--json").json
    whole = [each["place_id"] for each in document["places"]]
    whole += [each["object_id"] for each in document["objects"]]
    printed = "".join(
        mapfold(*words).out
        for words in (
            ("state", log),
            ("why", log, "p0"),
            ("why", log, "box"),
            ("diff", log, "3", "end", "--all"),
            ("find", log, "--all", "--top", "100"),
            ("whatif", log, "--set", "eps_m=0.1"),
            ("bisect", log, "located_in('box') == 'p2'"),
            ("relocalize", "--log", log, "--class", "box", "--class", "sink"),
            ("edit", log, "drop-object", "box", "--dry-run", "--all"),
            ("edit", log, "join", "p0", "p1", "--dry-run", "--all"),
        )
    )
    assert [each for each in whole if each in printed] == []
    short = set(re.findall(r"\bp[0-9]+\b|\bobj-[0-9a-f]+", printed))
    assert len(short) == len(whole)
    subjects = {mapfold("why", log, each, "--json").json["subject"] for each in short}
    assert subjects == {*whole}


def test_edits_and_conditions_take_them(mapfold: Commands, log: Path) -> None:
    def made(*words: str) -> Any:
        return mapfold("edit", log, *words, "--dry-run", "--json").json["command"]

    anchors = made("keep-apart", "kitchen", "p2")["places"]
    assert [anchor["keyframe_id"] for anchor in anchors] == [0, 20]
    assert len(made("drop-object", "box")["det_ids"]) == 4
    pair = made("different-objects", "Refrigerator", "toilet")["det_ids"]
    assert pair == ["run-a_kf0_d0", "run-a_kf10_d0"]

    def turns(condition: str) -> Any:
        return mapfold("bisect", log, condition, "--json").json["found"]["offset"]

    whole = turns(f"located_in('box') == '{SHED}'")
    assert turns("located_in('box') == 'p2'") == whole == turns("'p2' == located_in('BOX')")
    assert turns("size('bathroom') == 4") == turns(f"size('{BATHROOM}') == 4")
    said = mapfold("bisect", log, "located_in('box') == 'p9'", code=2).err
    assert "expression, column 22: no place 'p9' under these settings; near it: " in said
    said = mapfold("bisect", log, "sightings('sink') > 2", code=2).err
    assert "expression, column 11: 'sink' means 2 objects; give the id of one:\n  obj-" in said


def test_the_live_map_and_the_log_take_the_same(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, Settings())
    with LogReader(log) as reader:
        view = fold_log(reader, Settings())[1]
    (box,) = (each.object_id for each in view.objects.values() if each.class_name == "box")
    with connect_for_cypher(one_database.graph_url) as connection:
        prepare_graph(connection)
        live = read_view(connection)
    for map_ in (live, view):
        for text in ("BOX", box, box[4:10]):
            (answer,) = find(map_, Wanted(what=text, every=True)).answers
            assert (answer.object_id, answer.place_id) == (box, SHED)
        assert [room(map_, t).place_id for t in ("p1", "wc", "kitchen")] == [
            *(BATHROOM, BATHROOM, KITCHEN)
        ]
        assert [each.place_id for each in path(map_, "wc", "p1").places] == [BATHROOM]
        for text in ("p'; drop table x; --", "obj-0000000", "%", "\\"):
            with pytest.raises(NoSuchThing, match="under these settings"):
                room(map_, text)
            with pytest.raises(NoSuchThing, match="under these settings"):
                path(map_, "kitchen", text)


def test_python_takes_them(log: Path) -> None:
    house = fold(log)
    assert house.place("bathroom") == house.place("p1") == house.places[1]
    box = house.object("box")
    assert house.object(box["object_id"][:10]) == box
    with pytest.raises(SeveralThings, match="'sink' means 2 objects"):
        house.object("sink")
    with pytest.raises(NoSuchThing, match="no place 'cellar'"):
        house.place("cellar")
    with Timeline(log) as timeline:
        assert timeline.why("box")["subject"] == box["object_id"]
