"""`mapfold ui` over HTTP against the commands, which are asked as a person would."""

import json
import math
import random
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from projections.surfaces.python import Timeline
from tests.support.commands import Commands
from tests.support.logs import sample_drive, write_log
from tests.support.shared_data import ROOT, shared_run
from tests.support.thorough import rounds
from tests.support.ui_page import UiServer, read_arrays, replay, showing
from tests.unit.test_moved_things import ROOM
from tests.unit.test_moved_things import run as moved_run
from tests.unit.test_what_changed import LATER

WIDE = ("eps_m=1.0", "min_samples=8")
SETS = [word for text in WIDE for word in ("--set", text)]


NINES = "9" * 5_000
"""More digits than Python reads as a number."""


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy: histories and effects are kept beside a log."""
    return Path(shutil.copytree(sample_drive(), tmp_path_factory.mktemp("sample") / "log"))


@pytest.fixture(scope="module")
def mapfold(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    return Commands.in_folder(tmp_path_factory.mktemp("mapfold"))


@pytest.fixture(scope="module")
def server(mapfold: Commands, sample: Path) -> Iterator[UiServer]:
    with showing(mapfold, sample) as started:
        yield started


def run(mapfold: Commands, command: str, *more: str) -> str:
    """What the command line of an answer prints."""
    program, *words = shlex.split(command)
    assert program == "mapfold"
    return mapfold(*words, *more).out


def moments(end: int) -> list[int]:
    chosen = random.Random(19)
    return sorted({0, 1, end, *(chosen.randrange(end) for _ in range(rounds(200, 2)))})


def check_digests_and_arrays(mapfold: Commands, server: UiServer, log: Path, *sets: str) -> None:
    """At many W the digest and the replayed arrays are what ``state --at W`` prints."""
    header, arrays = read_arrays(server.ask("/api/history", set=sets).body)
    words = [word for text in sets for word in ("--set", text)]
    for at in moments(header["through"]):
        answer = server.api("digest", at=at, set=sets)
        state = mapfold("state", log, "--at", str(at), "--json", *words).json
        assert answer["digest"] == state["digest"], at
        found = replay(header, arrays, at)
        assert [[*k[:2], found.place_ids.get(k[2])] for k in found.keyframes] == [
            [k["run_id"], k["keyframe_id"], k["place_id"]] for k in state["keyframes"]
        ]
        assert {found.place_ids[p]: len(m) for p, m in found.places.items()} == {
            p["place_id"]: p["keyframe_count"] for p in state["places"]
        }
        assert {
            (o["id"], o["class_name"], o["count"], found.place_ids.get(o["place"]))
            for o in found.objects.values()
        } == {
            (o["object_id"], o["class_name"], o["obs_count"], o["place_id"])
            for o in state["objects"]
        }
        assert {
            (found.place_ids[a], found.place_ids[b], n) for (a, b), n in found.adjacency.items()
        } == {(e["a"], e["b"], e["shared_transitions"]) for e in state["adjacency"]}


def test_digests_and_arrays_are_those_of_state(
    mapfold: Commands, server: UiServer, sample: Path
) -> None:
    check_digests_and_arrays(mapfold, server, sample)


@pytest.mark.slow
def test_under_other_settings_too(mapfold: Commands, server: UiServer, sample: Path) -> None:
    check_digests_and_arrays(mapfold, server, sample, *WIDE)


@pytest.mark.slow
@pytest.mark.timeout(900)  # it starts two hundred programs
def test_on_a_real_house(mapfold: Commands, tmp_path: Path) -> None:
    house = [json.loads(line) for line in shared_run("house-a")]
    log = write_log(tmp_path / "log", house)
    with showing(mapfold, log) as server:
        check_digests_and_arrays(mapfold, server, log)
        check_digests_and_arrays(mapfold, server, log, "fusion=evidence")


class TestTexts:
    """``lines`` are what ``command`` prints."""

    def same(self, mapfold: Commands, answer: dict[str, Any]) -> dict[str, Any]:
        printed = run(mapfold, answer["command"])
        assert answer["lines"] == printed.splitlines()
        return answer

    def test_why(self, mapfold: Commands, server: UiServer) -> None:
        answer = server.api("why", what="place:sim-7-a_p7", set=WIDE)
        self.same(mapfold, answer)
        assert answer["steps"][-1]["offset"] == 348
        refs = answer["steps"][-1]["refs"]
        assert {"kind": "merge", "id": "348"} in refs
        assert {"kind": "place", "id": "sim-7-a_p0", "name": "p0"} in refs
        assert {"kind": "keyframe", "id": "sim-7-a/349"} in refs
        for ref in refs:  # each leads on
            assert server.api("why", what=f"{ref['kind']}:{ref['id']}", set=WIDE)["lines"]
        self.same(mapfold, server.api("why", what="object:obj-49730e517b887909", at=349, set=WIDE))
        pair = {"what": "keyframe:sim-7-a/10", "other": "keyframe:sim-7-a/310"}
        assert self.same(mapfold, server.api("why", **pair, set=WIDE))["facts"]["since"] == 348

    def test_a_merge_and_its_bridge(self, mapfold: Commands, server: UiServer) -> None:
        answer = self.same(mapfold, server.api("why", what="merge:348", set=WIDE))
        (merge,) = answer["merges"]
        assert merge["eps_m"] == 1.0
        assert [side["place_id"] for side in merge["sides"]] == ["sim-7-a_p0", "sim-7-a_p7"]
        assert [side["keyframes"] for side in merge["sides"]] == [32, 101]
        header, arrays = read_arrays(server.ask("/api/history", set=WIDE).body)
        names = {p["keyframe"]: p["name"] for p in merge["positions"]}
        assert [[names[k] for k in chain] for chain in merge["chain_points"]] == [
            chain["points"] for chain in merge["chains"]
        ]
        before, after = (replay(header, arrays, at) for at in (348, 349))
        first, last = merge["chain_points"][0][0], merge["chain_points"][0][-1]
        assert before.keyframes[first][2] != before.keyframes[last][2]
        assert after.keyframes[first][2] == after.keyframes[last][2]
        assert set(merge["made_core"]) <= set(merge["core"])
        where = {p["keyframe"]: (p["x"], p["y"]) for p in merge["positions"]}
        posed = [pose for pose in after.poses if pose is not None]
        for core in merge["core"]:  # counted by hand
            x, y = where[core]
            near = [p for p in posed if (p[0] - x) ** 2 + (p[1] - y) ** 2 <= 1.0 + 1e-5]
            assert len(near) >= 8

    def test_diff(self, mapfold: Commands, server: UiServer) -> None:
        answer = server.api("diff", **{"from": 348, "to": 349}, set=WIDE)
        assert answer["lines"] == run(mapfold, answer["command"], "--all").splitlines()
        assert answer["places"]["gone"][0]["into"] == "sim-7-a_p0"

    def test_bisect(self, mapfold: Commands, server: UiServer) -> None:
        condition = "same_place('sim-7-a:10', 'sim-7-a:310')"
        answer = self.same(mapfold, server.api("bisect", condition=condition, set=WIDE))
        assert answer["found"]["offset"] == 348
        scanned = server.api("bisect", condition="place_count() > 6", scan=1, set=WIDE)
        assert scanned["lines"] == run(mapfold, scanned["command"], "--all").splitlines()
        assert len(scanned["turns"]) > 1

    def test_a_condition_with_a_fault(self, server: UiServer) -> None:
        got = server.ask("/api/bisect", condition="size('sim-7-a_p0') >")
        assert got.status == 400
        assert got.json["error"]["column"] == 21
        answer = server.api("conditions", text="size(")
        assert answer["error"]["column"] == 5  # of the bracket that is not closed
        assert server.api("conditions", text="place_count() < 3")["error"] is None
        assert {f["name"] for f in answer["functions"]} >= {"same_place", "size", "located_in"}

    def test_whatif(self, mapfold: Commands, server: UiServer) -> None:
        answer = server.api("whatif", set="eps_m=0.6", grid=["min_samples=3,8"])
        assert answer["lines"] == run(mapfold, answer["command"], "--all").splitlines()
        assert answer["seconds"] > 0
        assert all(each["fold_seconds"] > 0 for each in answer["alternatives"])
        for each in answer["alternatives"]:
            sets = [f"{name}={value}" for name, value in each["set"].items()]
            assert server.api("digest", set=sets)["digest"] == each["digest"]

    def test_relocalize(self, mapfold: Commands, server: UiServer) -> None:
        seen = [server.api("keyframe", number=number) for number in range(400, 445)]
        number = max(seen, key=lambda k: len(k["detections"]))["number"]
        question = server.api("question", number=number)
        assert len(question["question"]["crops"]) > 1
        assert "pose" not in json.dumps(question["question"])
        body = json.dumps(question["question"]).encode()
        answer = server.ask("/api/relocalize?at=400", method="POST", body=body).json
        (mapfold.folder / "question.json").write_bytes(body)
        printed = json.loads(run(mapfold, answer["command"], "--json"))
        assert {name: answer[name] for name in printed} == printed
        assert len(answer["crops"]) == len(question["question"]["crops"])
        whole = server.ask("/api/relocalize", method="POST", body=body).json
        x, y, _ = question["truth"]  # the map has the very picture
        pose = whole["pose"]
        assert (pose["x"] - x) ** 2 + (pose["y"] - y) ** 2 < 1.5**2
        assert sum(weight for *_, weight in whole["poses"]) == pytest.approx(1.0)
        shares = [spot["share"] for spot in whole["spots"]]
        assert shares == sorted(shares, reverse=True)
        assert 0.9 < sum(shares) <= 1.0 + 1e-9
        assert math.hypot(whole["spots"][0]["x"] - x, whole["spots"][0]["y"] - y) < 1.5

    def test_a_keyframe_to_ask_with_is_picked(self, server: UiServer) -> None:
        end = server.api("log")["through"]
        picked = server.api("question")
        assert (picked["ask_at"], picked["whole"]) == (end, True)  # no map is older than the run
        seen = [server.api("keyframe", number=each) for each in range(0, 445, 20)]
        most = max(len(each["detections"]) for each in seen)
        assert len(picked["question"]["crops"]) >= most
        x, y, _ = picked["truth"]
        assert server.api("question", near=f"{x},{y}")["truth"][:2] == [x, y]


def test_search(server: UiServer) -> None:
    found = server.api("search", q="p3", set=WIDE)["found"]
    assert [each["id"] for each in found] == ["sim-7-a_p3"]
    chairs = server.api("search", q="Chair")["found"]
    assert server.api("search", q=chairs[0]["id"][4:10])["found"][0] == chairs[0]
    assert {each["text"] for each in chairs[:3]} == {"chair"}
    (keyframe,) = server.api("search", q="sim-7-a:310", kind="keyframe")["found"]
    assert (keyframe["id"], keyframe["number"]) == ("sim-7-a/310", 309)
    assert server.api("search", q="sim-7-a_kf310_d0")["found"][0]["kind"] == "detection"
    shown = server.api("keyframe", number=309)
    assert shown == server.api("keyframe", keyframe="sim-7-a/310")
    assert [each["det_id"] for each in shown["detections"]] == ["sim-7-a_kf310_d0"]
    assert server.api("search", q="no such thing")["found"] == []


def test_find_is_that_of_the_command(server: UiServer, mapfold: Commands) -> None:
    for query in (
        {"what": "chairs"},
        {"in": "p3", "top": 3, "all": 1, "at": 300, "set": WIDE},
        {"what": "chair", "near": "0,0", "set": WIDE},
    ):
        answer = server.api("find", **query)
        assert answer["answers"]
        printed = json.loads(run(mapfold, answer["command"], "--json"))
        assert {name: answer[name] for name in printed} == printed
    refused = server.ask("/api/find", what="unicorn")
    assert refused.status == 400
    assert "no class like 'unicorn'" in refused.error[2]
    assert server.ask("/api/find", what="chair", top=0).status == 400


def test_the_way_and_the_goal_are_those_of_the_command(server: UiServer, mapfold: Commands) -> None:
    thing = server.api("find", top=1)["answers"][0]["object_id"]
    place = server.api("overview")["rooms"][-1]["place_id"]
    found = server.api("path", **{"from": place, "to": thing})
    line = shlex.split(found["command"])[1:]
    assert found["path"] == mapfold(*line, "--json").json
    assert found["yaml"] == mapfold(*line, "--goal", "yaml").out
    alone = server.api("path", to=thing)
    assert (alone["path"], alone["goal"], alone["yaml"]) == (None, found["goal"], found["yaml"])
    assert alone["yaml"] == mapfold(*shlex.split(alone["command"])[1:]).out
    assert server.api("path", **{"from": place, "to": place})["goal"] is None


def test_the_overview_has_the_rooms_that_are_asked_for_one_by_one(
    server: UiServer, sample: Path
) -> None:
    overview = server.api("overview", at=300)
    with Timeline(sample) as timeline:
        known = timeline.at(300)
    assert len(overview["rooms"]) == len(known.places) > 0
    for each in overview["rooms"]:
        wanted = known.room(each["place_id"]).document()
        objects = len(wanted.pop("objects"))
        del wanted["neighbours"]
        listed = {name: each[name] for name in wanted}
        assert json.dumps(listed) == json.dumps(wanted)
        assert each["objects"] == objects
    assert not overview["crops"]


def test_changes_are_those_of_the_command(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", [*moved_run("a", ROOM), *moved_run("b", LATER)])
    with showing(mapfold, log, "--set", "fusion=evidence") as server:
        for query in ({}, {"since": "a", "until": "b"}, {"since": 9, "until": 150}):
            answer = server.api("changes", **query)
            printed = json.loads(run(mapfold, answer["command"], "--json"))
            assert {name: answer[name] for name in printed} == printed
        told = [(each["kind"], each["class_name"]) for each in server.api("changes")["changes"]]
        assert told == [("moved", "chair"), ("missing", "plant"), ("new", "bed")]
        assert "no run 'c'" in server.ask("/api/changes", since="c").error[2]


@pytest.mark.parametrize(
    ("path", "status", "kind", "said"),
    [
        ("changes", 400, "bad_question", "only a map with fusion by evidence"),
        ("digest?at=446", 400, "bad_question", "446"),
        (f"digest?at={NINES}", 400, "bad_question", "9999… is beyond the end"),
        (f"digest?at=sim-7-a:{NINES}", 400, "bad_question", "no such keyframe"),
        (f"digest?known_at={NINES}", 400, "bad_question", "is beyond the end"),
        (f"history?from={NINES}", 400, "bad_question", "from is '9999"),
        (f"why?what=keyframe:sim-7-a/{NINES}", 404, "not_found", "no keyframe"),
        (f"why?what=merge:{NINES}", 400, "bad_question", "names no offset"),
        ("question?near=1", 400, "bad_question", "near is '1'; give it as X,Y"),
        ("question?near=nan,2", 400, "bad_question", "near is 'nan,2'"),
        (f"keyframe?number={NINES}", 400, "bad_question", "number is '9999"),
        (f"diff?from=1&to={NINES}", 400, "bad_question", "is beyond the end"),
        ("digest?at=tomorrow", 400, "bad_question", "tomorrow"),
        ("digest?at=-1", 400, "bad_question", "-1"),
        ("digest?set=eps=1", 400, "bad_settings", "no setting 'eps'"),
        ("find?what=cup&set=%20text_encoder=/x.onnx", 400, "bad_settings", "names a file"),
        ("digest?eps_m=nan", 400, "bad_settings", "eps_m"),
        ("history?from=x", 400, "bad_question", "from is 'x'"),
        ("why", 400, "bad_question", "what is missing"),
        ("why?what=chair:1", 400, "bad_question", "chair:1"),
        ("why?what=place:sim-7-a_p99", 404, "not_found", "sim-7-a_p0"),
        ("why?what=merge:5", 404, "not_found", "5"),
        ("why?what=merge:x", 400, "bad_question", "merge:x"),
        ("why?what=keyframe:sim-7-a/9999", 404, "not_found", "near it: sim-7-a:445"),
        (
            "keyframe?number=445",
            404,
            "not_found",
            "no keyframe number '445' in this log; near it: 444",
        ),
        (
            "search?q=a&kind=chair",
            400,
            "bad_question",
            "kind is 'chair'; give one of place, object",
        ),
        ("whatif", 400, "bad_question", "nothing to try"),
        ("whatif?without=nothing", 404, "not_found", "no command"),
        ("diff?from=1", 400, "bad_question", "to is missing"),
        ("nothing", 404, "bad_question", "/api/nothing"),
    ],
)
def test_a_wrong_question_gets_a_sentence(
    server: UiServer, path: str, status: int, kind: str, said: str
) -> None:
    got = server.ask(f"/api/{path}")
    assert got.error[:2] == (status, kind)
    assert said in got.error[2]


def test_unknown_empty_and_repeated_parameters_are_refused_on_every_path(server: UiServer) -> None:
    operations = json.loads(server.ask("/openapi.json").body)["paths"]
    paths = [(path, method) for path, methods in operations.items() for method in methods]
    assert len(paths) > 14
    for path, method in (*paths, ("/openapi.json", "get"), ("/docs", "get")):
        body = b"{}" if method == "post" else None
        status, kind, said = server.ask(f"{path}?mistake=1", method=method.upper(), body=body).error
        assert (status, kind) == (400, "bad_question"), path
        assert said.startswith("no parameter called 'mistake'; there are "), path
        for name in said.removesuffix(", token").partition("there are ")[2].split(", "):
            got = server.ask(f"{path}?{name}=", method=method.upper(), body=body)
            assert got.error == (
                400,
                "bad_question",
                f"{name} is empty; give a value, or leave {name} out",
            )
    repeated = server.ask("/api/digest?at=1&at=2").error
    assert repeated == (400, "bad_question", "at is given 2 times; give it once")
    assert server.ask("/api/digest?at=9&set=eps_m=2&set=min_samples=2").status == 200


@pytest.mark.parametrize("path", ["/api/log", "/api/log/", "/api/why", "/docs", "/", "/nothing"])
def test_a_wrong_method_or_path_is_refused_with_json(server: UiServer, path: str) -> None:
    for method in ("HEAD", "DELETE", "OPTIONS"):
        got = server.ask(path, method=method)
        assert got.status in (404, 405)
        if method != "HEAD":
            assert got.error[1] == "bad_question"
    if path == "/api/log/":
        assert server.ask(path).error[:2] == (404, "bad_question")


def test_the_schema_names_every_question(server: UiServer) -> None:
    paths = json.loads(server.ask("/openapi.json").body)["paths"]
    page = (ROOT / "docs" / "ui.md").read_text("utf-8")
    for path in paths:
        assert f"{path}" in page, path
