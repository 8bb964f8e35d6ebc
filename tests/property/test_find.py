"""Answers of `find` against the whole state, gone through line by line."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import UseSettings
from projections.ask.find import Wanted, find
from projections.fold.settings import Settings
from projections.map.naming import NoSuchThing, SeveralThings
from projections.map.state_output import state_document
from projections.map.view import MapView
from projections.surfaces import python as api
from tests.support.commands import Commands
from tests.support.evidence_drives import CLASSES, drives, long_drive
from tests.support.folds import Folded
from tests.support.logs import append_command, command, write_log
from tests.support.thorough import examples

FULL = Settings(places="rooms", fusion="evidence")
QUESTIONS = st.builds(
    Wanted,
    what=st.sampled_from([None, *CLASSES]),
    room=st.none() | st.sampled_from(["p0", "p1"]),
    near=st.none() | st.tuples(st.integers(-4, 9), st.integers(-4, 9)).map("{0[0]},{0[1]}".format),
    missing=st.booleans(),
    moved=st.booleans(),
    seen_since=st.none() | st.integers(0, 40).map(lambda n: 1774357200.0 + n),
    not_seen_since=st.none() | st.integers(0, 40).map(lambda n: 1774357200.0 + n),
    top=st.integers(1, 12),
    every=st.booleans(),
)


def oracle(view: MapView, wanted: Wanted, room: str | None) -> list[str]:
    """Ids of all answers, best first; ``room`` is the id of the place wanted."""
    kept: list[tuple[Any, str]] = []
    for number, each in enumerate(state_document(view, None)["objects"]):
        x, y = each.get("est_x", each["mean_x"]), each.get("est_y", each["mean_y"])
        away = 0.0
        if wanted.near is not None:
            to_x, to_y = map(float, wanted.near.split(","))
            away = ((x - to_x) ** 2 + (y - to_y) ** 2) ** 0.5
        checks = [
            wanted.what in (None, each["class_name"]),
            wanted.room is None or each["place_id"] == room,
            not wanted.missing or each["missing"],
            not wanted.moved or bool(each["relocations"]),
            wanted.seen_since is None or each["last_seen"] >= wanted.seen_since,
            wanted.not_seen_since is None or each["last_seen"] < wanted.not_seen_since,
            wanted.every or each["confirmed"],
        ]
        if all(checks):
            kept.append(((away, each["missing"], -each["obs_count"], number), each["object_id"]))
    return [object_id for _, object_id in sorted(kept)]


@given(documents=drives(most=40), wanted=QUESTIONS)
@settings(max_examples=examples(300))
def test_answers_are_those_of_the_state(documents: list[dict[str, Any]], wanted: Wanted) -> None:
    view = Folded.start(FULL).extend(documents).view
    room = [p for p in view.places.values() if p.place_id.endswith(f"_{wanted.room}")]
    room = room or [p for p in view.all_places if p.place_id.endswith(f"_{wanted.room}")]
    if wanted.room is not None and len(room) != 1:
        with pytest.raises((NoSuchThing, SeveralThings)):
            find(view, wanted)
        return
    place_id = view.place_id(view.survivors.find(room[0].ordinal)) if room else None
    if wanted.what is not None and wanted.what not in {o.class_name for o in view.objects.values()}:
        return
    expected = oracle(view, wanted, place_id)
    found = find(view, wanted)
    assert [each.object_id for each in found.answers] == expected[: wanted.top]
    assert found.count == len(expected)
    assert found.unconfirmed == len(oracle(view, replace(wanted, every=True), place_id)) - len(
        expected
    )
    times = {k.offset: (k.timestamp, k.run_id, k.keyframe_id) for k in view.keyframes}
    for answer in found.answers:
        seen = sorted((*times[offset][:1], offset) for offset in answer.offsets)
        for said, (time, offset) in ((answer.first_seen, seen[0]), (answer.last_seen, seen[-1])):
            assert (said.time, said.offset) == (time, offset)
            assert (said.time, said.run_id, said.keyframe_id) == times[offset]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_log(tmp_path_factory.mktemp("find") / "log", long_drive(5, each=30))
    append_command(folder, command(UseSettings, settings={"places": "rooms", "fusion": "evidence"}))
    return folder


@pytest.fixture(scope="module")
def house(log: Path) -> api.Map:
    return api.fold(log)


@pytest.mark.parametrize(
    ("arguments", "keywords"),
    [
        (["cups"], {"what": "cups"}),
        (["chair", "--near", "1.5,2", "--all"], {"what": "chair", "near": (1.5, 2), "every": True}),
        (["--in", "run-0_p0", "--top", "3"], {"room": "run-0_p0", "top": 3}),
        (["--moved"], {"moved": True}),
        (["--missing"], {"missing": True}),
        (
            ["lamp", "--seen-since", "2026-03-24T13:01:00Z"],
            {"what": "lamp", "seen_since": 1774357260.0},
        ),
        (
            ["--not-seen-since", "2026-03-24T13:02:00Z"],
            {"not_seen_since": "2026-03-24T13:02:00Z"},
        ),
    ],
)
def test_the_command_and_python_give_the_same_answers(
    log: Path,
    house: api.Map,
    mapfold: Commands,
    arguments: list[str],
    keywords: dict[str, Any],
) -> None:
    said = mapfold("find", log, *arguments, "--json")
    found = house.find(**keywords)
    assert json.loads(said.out) == json.loads(json.dumps(found.document()))
    text = mapfold("find", log, *arguments)
    for answer in found.answers:
        assert answer.object_id[:10] in text.out
    assert found.answers or "nothing found" in text.out


def test_what_has_moved_is_told_with_where_it_was(house: api.Map) -> None:
    moved = house.find(moved=True, every=True, top=100).answers
    assert moved
    for answer in moved:
        assert answer.moved_from is not None
        (record,) = [o for o in house.objects if o["object_id"] == answer.object_id]
        last = record["relocations"][-1]
        assert answer.moved_from == tuple(last["from"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["xyzzy"], "no class like 'xyzzy' in this map; there are chair, cup, lamp"),
        (["cup", "--in", "ballroom"], "no place 'ballroom'"),
        (["cup", "--near", "nan,1"], "no place or object 'nan,1'"),
        (["cup", "--near", "1_0,1"], "no place or object '1_0,1'"),
        (["cup", "--near", "1e999,1"], "no place or object '1e999,1'"),
        (["cup", "--near", "cup"], "'cup' means"),
        (["cup", "--seen-since", "yesterday"], "'yesterday' is no time"),
        (["cup", "--moved", "--preset", "classic"], "only a map with fusion by evidence knows"),
        (["\x1b[31m"], "no class like '\\x1b[31m' in this map"),
        (["cup" * 10_000], "no class like"),
    ],
)
def test_what_cannot_be_answered_is_an_error_that_says_why(
    log: Path, mapfold: Commands, arguments: list[str], said: str
) -> None:
    answer = mapfold("find", log, *arguments, code=2)
    assert said in answer.err
    assert len(answer.err) < 2_000


def test_a_place_is_no_object_and_the_error_says_how_to_ask(house: api.Map) -> None:
    place_id = house.places[0]["place_id"]
    with pytest.raises(
        MisuseError, match=r"is a place: .*; `mapfold find --in .*` lists what is in it"
    ):
        house.find(place_id)
    with pytest.raises(MisuseError, match="'now' is no time"):
        house.find(seen_since="now")


def test_an_object_is_found_by_its_id_also_one_seen_once(house: api.Map) -> None:
    for record in house.objects:
        (answer,) = house.find(record["object_id"]).answers
        assert answer.object_id == record["object_id"]
        assert answer.match == "id"
        (same,) = house.find(record["object_id"][:12]).answers
        assert same == answer
