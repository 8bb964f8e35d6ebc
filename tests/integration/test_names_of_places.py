"""A place's name is beside its id in every answer, of the live map and of a folded log alike."""

import json
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader
from projections.ask.find import Wanted, find
from projections.ask.room_and_path import path, room
from projections.fold.settings import Settings
from projections.localize.relocalize import ExactIndex, rank, read_question
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.cypher import connect_for_cypher
from projections.postgres.queries.candidate_search import CandidateReader, prepare_graph
from projections.postgres.queries.live_view import read_view
from projections.surfaces.serve import Answerer, Pools
from tests.support.logs import append_command, name_place, walk, write_log

SETTINGS = Settings()
NAME = 'Küche "1"'


@pytest.fixture
def documents() -> list[dict[str, Any]]:
    return walk(120)


@pytest.fixture
def log(tmp_path: Path, documents: list[dict[str, Any]]) -> Path:
    """Three rooms, of which one has a name."""
    log = write_log(tmp_path / "log", documents)
    append_command(log, name_place(3, NAME))
    return log


def test_queries_of_the_live_map_and_of_the_log_show_the_same_names(
    log: Path, one_database: Targets
) -> None:
    rebuild(log, one_database, SETTINGS)
    with LogReader(log) as reader:
        _, view = fold_log(reader, SETTINGS, corrections=read_corrections(reader))
    (named,) = (p for p in view.places.values() if p.name is not None)
    other = next(p for p in view.places.values() if p.name is None)
    inside = next(o for o in view.objects.values() if o.place == named.ordinal)
    with connect_for_cypher(one_database.graph_url) as connection:
        prepare_graph(connection)
        live = read_view(connection)
    answers = [
        [
            find(map_, Wanted(what=inside.object_id)).document(),
            room(map_, named.place_id).document(),
            room(map_, other.place_id).document(),
            path(map_, named.place_id, other.place_id).document(),
        ]
        for map_ in (live, view)
    ]
    assert answers[0] == answers[1]
    found, in_named, in_other, way = answers[0]
    assert found["answers"][0]["place_name"] == NAME
    assert in_named["name"] == NAME
    assert {o["place_name"] for o in in_named["objects"]} == {NAME}
    assert {o["place_name"] for o in in_other["objects"]} == {None}
    assert [step["name"] for step in way["places"]] == [NAME, *[None] * (len(way["places"]) - 1)]


def test_answers_to_where_is_this_show_the_name(
    log: Path, one_database: Targets, documents: list[dict[str, Any]]
) -> None:
    rebuild(log, one_database, SETTINGS)
    with LogReader(log) as reader:
        _, view = fold_log(reader, SETTINGS, corrections=read_corrections(reader))
    seen = [d["detections"] for d in documents if d["detections"]]
    question = next(s for s in seen if all("embedding" in d for d in s))
    crops = read_question({"crops": question}).crops
    with CandidateReader(one_database) as reader_of_candidates:
        candidates = reader_of_candidates.candidates(crops)
    answer = rank(crops, candidates, top=9).document()
    folded = rank(crops, ExactIndex(view).search(crops), top=9).document()
    assert [p.get("name") for p in answer["places"]] == [p.get("name") for p in folded["places"]]
    names = {place["place_id"]: place.get("name") for place in answer["places"]}
    expected = {p.place_id: p.name for p in view.places.values()}
    assert names == {place_id: expected[place_id] for place_id in names}
    assert NAME in names.values()
    assert any("name" not in place for place in answer["places"])
    with Pools(one_database, 1, lambda _: None) as pools:
        answerer = Answerer(pools, per_second=100.0)
        served = answerer.relocalize(json.dumps({"crops": question, "top": 9}).encode(), {})
        assert served["places"] == answer["places"]
        near = answerer.state("places", {"x": "6", "y": "0", "radius": "50"})["places"]
    assert {place["place_id"]: place.get("name") for place in near} == expected
