"""Fifteen questions of a map whose truth is known, each one command: the command, Python, an agent
(MCP) and HTTP give the same JSON, and it is right.

A robot drives past a chair, a table, a plant and a tv; a day later the plant is gone, the chair
stands elsewhere, and a bed is new.
"""

import json
import math
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import UseSettings
from projections.fold.map_errors import ProjectionMismatch
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.python import Map, Timeline, fold
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.asked import (
    ChangesQuery,
    FindQuery,
    LogBusyError,
    NotInMapError,
    ServedLog,
)
from tests.support.commands import Commands
from tests.support.logs import append_command, command, write_log
from tests.support.serve_questions import DEADLINE_S, http_at
from tests.unit.test_moved_things import ROOM, run
from tests.unit.test_what_changed import LATER, SETTINGS

DAY_S = 86400.0
BETWEEN = "2026-03-25T00:00:00Z"
"""After run a, before run b."""


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    tomorrow = [{**each, "timestamp": each["timestamp"] + DAY_S} for each in run("b", LATER)]
    folder = tmp_path_factory.mktemp("asked") / "log"
    write_log(folder, [*run("a", ROOM), *tomorrow])
    append_command(folder, command(UseSettings, settings={"fusion": "evidence"}))
    return folder


@pytest.fixture(scope="module")
def mapfold(log: Path) -> Commands:
    return Commands.in_folder(log.parent)


@pytest.fixture(scope="module")
def printed(mapfold: Commands, log: Path) -> Callable[[str, tuple[str, ...]], Any]:
    """What a command prints, run once however often it is asked for."""
    return cache(lambda name, words: mapfold(name, log, *words, "--json").json)


@pytest.fixture(scope="module")
def house(log: Path) -> Map:
    return fold(log)


@pytest.fixture(scope="module")
def http(log: Path, module_database: Targets) -> Iterator[str]:
    rebuild(log, module_database, SETTINGS)
    with Pools(module_database, 2) as pools, FairQueue(2) as queue, ExitStack() as stack:
        beside = stack.enter_context(closing(ServedLog(log)))
        answerer = Answerer(pools, per_second=1000.0, log=beside)
        with http_at(answerer, queue) as port:
            yield f"http://127.0.0.1:{port}"


def near(answer: Any, spot: tuple[float, float], most: float = 0.4) -> bool:
    return math.dist((answer["x"], answer["y"]), spot) <= most


def classes(document: Any) -> list[str]:
    return [answer["class_name"] for answer in document["answers"]]


Question = tuple[str, tuple[str, ...], Callable[[Map], Any], str, Callable[[dict[str, Any]], bool]]
QUESTIONS: list[Question] = [
    (
        "where is a chair?",
        ("find", "chairs"),
        lambda house: house.find("chairs"),
        "/find?what=chairs",
        lambda d: classes(d) == ["chair"] and near(d["answers"][0], LATER["chair"]),
    ),
    (
        "what is in this room?",
        ("find", "--in", "p0"),
        lambda house: house.find(room="p0"),
        "/find?in=p0",
        lambda d: set(classes(d)) == {*ROOM, "bed"},
    ),
    (
        "what is nearest to me?",
        ("find", "--near", "6.0,1.5", "--top", "2"),
        lambda house: house.find(near=(6.0, 1.5), top=2),
        "/find?near=6.0,1.5&limit=2",
        lambda d: classes(d) == ["tv", "chair"],
    ),
    (
        "what is nearest by the way?",
        ("find", "--from", "0,0", "--top", "1"),
        lambda house: house.find(start=(0, 0), top=1),
        "/find?from=0,0&limit=1",
        lambda d: classes(d) == ["table"] and d["answers"][0]["way_m"] >= 2.0,
    ),
    (
        "when was the plant last seen, and by whom?",
        ("find", "plant"),
        lambda house: house.find("plant"),
        "/find?what=plant",
        lambda d: d["answers"][0]["last_seen"]["run_id"] == "a",
    ),
    (
        "what is missing?",
        ("find", "--missing"),
        lambda house: house.find(missing=True),
        "/find?missing=true",
        lambda d: classes(d) == ["plant"] and d["answers"][0]["missing_in"] == "b",
    ),
    (
        "what has moved, and from where?",
        ("find", "--moved"),
        lambda house: house.find(moved=True),
        "/find?moved=true",
        lambda d: (
            classes(d) == ["chair"]
            and math.dist(d["answers"][0]["moved_from"], ROOM["chair"]) < 0.4
        ),
    ),
    (
        "what was seen today?",
        ("find", "--seen-since", BETWEEN),
        lambda house: house.find(seen_since=BETWEEN),
        f"/find?seen_since={BETWEEN}",
        lambda d: set(classes(d)) == {*LATER},
    ),
    (
        "what was not?",
        ("find", "--not-seen-since", BETWEEN),
        lambda house: house.find(not_seen_since=BETWEEN),
        f"/find?not_seen_since={BETWEEN}",
        lambda d: classes(d) == ["plant"],
    ),
    (
        "which tabel?",
        ("find", "tabel"),
        lambda house: house.find("tabel"),
        "/find?what=tabel",
        lambda d: d["match"] == "spelling" and near(d["answers"][0], ROOM["table"]),
    ),
    (
        "what is this room?",
        ("room", "p0"),
        lambda house: house.room("p0"),
        "/rooms/p0",
        lambda d: {o["class_name"] for o in d["objects"]} == {*ROOM, "bed"},
    ),
    (
        "how do I get to the tv?",
        ("path", "0,0", "tv"),
        lambda house: house.path((0, 0), "tv"),
        "/path?from=0,0&to=tv",
        lambda d: near(d["goal"], ROOM["tv"], 2.6) and 4.0 < d["length_m"] < 8.0,
    ),
    (
        "where do I stand to see the bed?",
        ("find", "bed", "--goal", "json"),
        lambda house: house.goal("bed"),
        "/objects/bed/goal",
        lambda d: d["ground"] == "seen" and near(d, LATER["bed"], 2.6),
    ),
    (
        "where was the chair yesterday?",
        ("find", "chair", "--at", "a:95", "--known-at", "end"),
        lambda _: None,
        "/find?what=chair&at=a:95&known_at=end",
        lambda d: near(d["answers"][0], ROOM["chair"]),
    ),
    (
        "what changed since then?",
        ("changes", "--since", "b"),
        lambda _: None,
        "/changes?since=b",
        lambda d: (
            [(c["kind"], c["class_name"]) for c in d["changes"]]
            == [("moved", "chair"), ("missing", "plant"), ("new", "bed")]
        ),
    ),
]


def test_there_are_fifteen() -> None:
    assert len(QUESTIONS) == len(BY_AGENT) == 15


BY_AGENT: list[tuple[str, dict[str, Any]]] = [
    ("find", {"what": "chairs"}),
    ("find", {"room": "p0"}),
    ("nearest", {"near": "6.0,1.5", "top": 2}),
    ("nearest", {"near": "0,0", "by_way": True, "top": 1}),
    ("find", {"what": "plant"}),
    ("find", {"missing": True}),
    ("find", {"moved": True}),
    ("find", {"seen_since": BETWEEN}),
    ("find", {"not_seen_since": BETWEEN}),
    ("find", {"what": "tabel"}),
    ("room", {"name": "p0"}),
    ("path", {"start": "0,0", "end": "tv"}),
    ("goal", {"thing": "bed"}),
    ("find", {"what": "chair", "at": "a:95", "known_at": "end"}),
    ("changes", {"since": "b"}),
]
"""The tool of `mapfold mcp` for each question, and its arguments."""


@pytest.fixture(scope="module")
def agent(log: Path) -> Iterator[Any]:
    pytest.importorskip("mcp", reason="the extra [mcp] is not installed")
    from projections.surfaces.mcp.agent_server import create_server
    from projections.surfaces.mcp.cited_maps import LogMaps

    with LogMaps(log, lambda _: SETTINGS) as maps:
        yield create_server(maps)


@pytest.mark.parametrize("number", range(15), ids=[question[0] for question in QUESTIONS])
def test_an_agent_gets_what_the_command_prints(
    number: int, printed: Callable[[str, tuple[str, ...]], Any], agent: Any
) -> None:
    from tests.support.agents import tool

    _, (name, *words), *_, is_right = QUESTIONS[number]
    told = printed(name, tuple(words))
    called, arguments = BY_AGENT[number]
    answer = tool(agent, called, **arguments)
    assert is_right(answer["answer"])
    assert answer["answer"] == told
    assert answer["offsets"]
    assert answer["map"]["digest"]


@pytest.mark.parametrize("question", QUESTIONS, ids=[question[0] for question in QUESTIONS])
def test_each_is_answered_rightly_and_alike_everywhere(
    question: Question,
    printed: Callable[[str, tuple[str, ...]], Any],
    house: Map,
    http: str,
    log: Path,
) -> None:
    _, (name, *words), in_python, url, is_right = question
    by_command = printed(name, tuple(words))
    assert is_right(by_command)
    if name == "changes":
        with Timeline(log) as timeline:
            by_python: Any = timeline.changes("b")
    elif "--at" in words:
        by_python = fold(log, at="a:95", known_at="end").find("chair")
    else:
        by_python = in_python(house)
    assert json.loads(json.dumps(by_python.document())) == by_command
    with urllib.request.urlopen(http + url, timeout=DEADLINE_S) as answer:
        by_http = json.loads(answer.read())
    by_http.pop("next", None)
    assert by_http == by_command


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("/find?what=xyzzy", "no class like 'xyzzy' in this map"),
        ("/rooms/ballroom", "no place 'ballroom'"),
        ("/objects/obj-000000", "no object 'obj-000000'"),
        ("/path?from=0,0&to=nan,1", "no place or object 'nan,1'"),
        ("/find?seen_since=yesterday", "'yesterday' is no time"),
        ("/changes?since=yesterday", "no run 'yesterday'"),
        ("/changes?until=999", "999"),
        ("/find?what=chair&at=999", "999"),
        ("/objects/xyzzy/goal", "no object 'xyzzy'"),
    ],
)
def test_what_the_map_does_not_have_is_refused_in_one_form(http: str, path: str, said: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(http + path, timeout=DEADLINE_S)
    error = json.loads(refused.value.read())["error"]
    assert (refused.value.code, error["kind"]) == (404, "bad_question")
    assert said in error["message"]


def test_changes_come_in_pages(http: str) -> None:
    pages, cursor = list[Any](), "0"
    while cursor:
        url = f"{http}/changes?since=b&limit=2&cursor={cursor}"
        with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:
            pages.append(json.loads(answer.read()))
        cursor = pages[-1].get("next", "")
    assert [[c["class_name"] for c in page["changes"]] for page in pages] == [
        ["chair", "plant"],
        ["bed"],
    ]
    assert {page["counts"]["moved"] for page in pages} == {1}


def test_without_the_log_the_databases_do_not_know_what_changed(
    http: str, module_database: Targets, tmp_path: Path
) -> None:
    with Pools(module_database, 1) as pools:
        with pytest.raises(NotInMapError, match="start the service with --log LOG"):
            Answerer(pools, per_second=1000.0).changes(ChangesQuery())
        with pytest.raises(NotInMapError, match="start the service with --log LOG"):
            Answerer(pools, per_second=1000.0).find(FindQuery(known_at="end"))
        other = write_log(tmp_path / "other", run("a", ROOM))
        with closing(ServedLog(other)) as beside:
            with pytest.raises(ProjectionMismatch, match="give that log"):
                beside.refuse_other(pools.view())
            strange = Answerer(pools, per_second=1000.0, log=beside)
            with pytest.raises(ProjectionMismatch, match="give that log"):
                strange.changes(ChangesQuery())
            with pytest.raises(ProjectionMismatch, match="give that log"):
                strange.find(FindQuery(at="1"))


def test_a_second_question_of_the_log_does_not_wait_for_long(
    log: Path, module_database: Targets
) -> None:
    with Pools(module_database, 1) as pools, closing(ServedLog(log)) as beside:
        with beside._reading(view := pools.view()), ThreadPoolExecutor(1) as other:
            refused = other.submit(beside.changes, view, ChangesQuery()).exception(DEADLINE_S)
        assert isinstance(refused, LogBusyError)
        assert beside.changes(view, ChangesQuery(since="b"))["changes"]


def test_pages_follow_each_other(http: str, house: Map) -> None:
    seen, cursor = list[str](), "0"
    while cursor:
        url = f"{http}/find?limit=2&all=true&cursor={cursor}"
        with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:
            page = json.loads(answer.read())
        seen += [each["object_id"] for each in page["answers"]]
        cursor = page.get("next", "")
    assert seen == [each.object_id for each in house.find(every=True, top=1000).answers]
    with urllib.request.urlopen(f"{http}/objects/{seen[0]}", timeout=DEADLINE_S) as answer:
        assert json.loads(answer.read())["object_id"] == seen[0]
