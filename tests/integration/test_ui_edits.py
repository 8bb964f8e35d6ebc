"""`mapfold ui --allow-edits`: commands given on the page, tried first, and refused."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from tests.support.commands import Commands, cpu_seconds
from tests.support.logs import bridge, walk, write_log
from tests.support.thorough import every_other
from tests.support.ui_page import UiServer, digest, showing


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_log(tmp_path / "log", [*walk(30, seed=2), *bridge()])


@pytest.fixture
def server(mapfold: Commands, log: Path) -> Iterator[UiServer]:
    with showing(mapfold, log, "--allow-edits") as started:
        yield started


def test_a_dry_run_a_command_and_its_undo(mapfold: Commands, log: Path, server: UiServer) -> None:
    offset = str(server.api("merges")["merges"][0]["offset"])
    before = server.api("digest")["digest"]
    preview = server.edit("undo-merge", offset).json
    assert preview["recorded"] is False
    assert preview["through"] == server.api("log")["through"] == 50
    assert preview["effect"]["places"] > 0
    got = server.edit("undo-merge", offset, dry_run=False)
    assert got.error == (
        400, "bad_question",
        "the reason is missing: say why, for later readers of the log",
    )  # fmt: skip
    done = server.edit("undo-merge", offset, dry_run=False, reason="two rooms").json
    assert (done["recorded"], done["offset"], done["through"]) == (True, 50, 51)
    assert done["effect"] == preview["effect"]
    after = server.api("digest")["digest"]
    assert after == preview["difference"]["digests"][1] == digest(mapfold, log)
    listed = mapfold("edits", log, "--json").json
    assert listed[0]["reason"] == "two rooms"
    again = {"reason": "two rooms", "dry_run": False, "command_id": done["command_id"]}
    assert server.edit("undo-merge", offset, **again).json["repeated"] is True
    undone = server.edit("undo", done["command_id"], dry_run=False, reason="no").json
    assert undone["through"] == 52
    assert server.api("digest")["digest"] == digest(mapfold, log)
    answer = server.api("corrections")
    assert answer["corrections"][0]["undone_by"] == undone["command_id"]
    told = [{k: v for k, v in c.items() if k != "text"} for c in answer["corrections"]]
    assert told == mapfold("edits", log, "--json").json
    known = server.api("digest", at=50, known_at=50)["digest"]
    assert known == before


def test_a_name_needs_no_reason_and_is_previewed_without_a_fold(
    mapfold: Commands, log: Path, server: UiServer
) -> None:
    for name in ("hall", "corridor", "hall"):
        used_s = cpu_seconds(server.program.pid)
        preview = server.edit("name-place", "run-a_p0", name).json
        assert cpu_seconds(server.program.pid) - used_s < 0.3
        assert preview["effect"] == {"places": 1, "objects": 0, "keyframes": 0}
        named = server.edit("name-place", "run-a_p0", name, dry_run=False).json
        assert named["recorded"] is True
        assert preview["difference"]["digests"][1] == digest(mapfold, log)


def test_every_kind_says_what_the_command_says(
    mapfold: Commands, log: Path, server: UiServer
) -> None:
    """The same change, or the same sentence."""
    state = mapfold("state", log, "--json").json
    place, objects = state["places"][0]["place_id"], state["objects"]
    det_id = objects[0]["det_ids"][0]
    edits = [
        ("name-place", place, "kitchen"),
        ("keep-apart", "run-a:1", "run-b:3"),
        ("join", place, "run-b:3"),
        ("same-object", objects[0]["object_id"], objects[1]["object_id"]),
        ("different-objects", *objects[0]["det_ids"][:2]),
        ("drop-object", objects[0]["object_id"]),
        ("drop-detection", det_id, objects[1]["det_ids"][0]),
        ("forget-run", "run-b"),
        ("forget-keyframes", "run-a", "3..9"),
        ("relabel", "cup=mug", "17=chair"),
        ("undo", "nothing"),
        ("undo-merge", "9999"),
    ]
    for kind, *arguments in every_other(edits):
        got = server.edit(kind, *arguments)
        words = ("edit", log, kind, "--dry-run", "--json", "--", *arguments)
        said = mapfold(*words, code=None)
        if said.code == 0:
            assert got.status == 200, got.body
            assert got.json["effect"] == said.json["effect"], kind
            assert got.json["difference"] == said.json["difference"], kind
        else:
            assert got.status in (400, 404), kind
            assert said.err == f"mapfold: {got.error[2]}\n"
    got = server.edit("correct-poses", "run-a", "1.5", "0", "0").json
    words = ("correct-poses", "run-a", "--dx", "1.5", "--dy", "0", "--dyaw", "0")
    said = mapfold("edit", log, *words, "--dry-run", "--json").json
    assert got["difference"] == said["difference"]
    got = server.edit("use-settings", "eps_m=0.5").json
    words = ("use-settings", "--set", "eps_m=0.5")
    said = mapfold("edit", log, *words, "--dry-run", "--json").json
    assert got["difference"] == said["difference"]
    assert server.api("log")["through"] == 50


def test_nonsense(server: UiServer) -> None:
    bearer = {"Authorization": f"Bearer {server.token}"}
    far = {"kind": "correct-poses", "arguments": ["run-a", "x", "0", "0"]}
    for document, said in (
        ([], "the edit"),
        ({}, "kind"),
        ({"kind": "nothing"}, "no edit 'nothing'"),
        ({"kind": "undo"}, "undo has 0 arguments; give COMMAND_ID"),
        ({"kind": "undo", "arguments": ["a", "b"]}, "undo has 2 arguments"),
        ({"kind": "undo", "arguments": [1]}, "arguments.0"),
        ({"kind": "undo", "arguments": "a"}, "arguments"),
        (
            {"kind": "undo-merge", "arguments": ["x"]},
            "undo-merge takes the offset of a merge, not 'x'",
        ),
        (far, "'x' is no number"),
        ({"kind": "undo", "more": 1}, "more"),
    ):
        body = json.dumps(document).encode()
        got = server.ask("/api/edit", method="POST", body=body, headers=bearer)
        assert got.error[:2] == (400, "bad_question")
        assert said in got.error[2]


def test_a_log_that_another_writer_holds(log: Path, server: UiServer) -> None:
    with LogWriter(log):
        assert server.edit("forget-run", "run-b").json["recorded"] is False
        got = server.edit("forget-run", "run-b", dry_run=False, reason="x")
        assert got.status == 500
        assert "a recorder" in got.error[2] or "no recorder" in got.error[2]
    assert server.edit("forget-run", "run-b", dry_run=False, reason="x").json["recorded"]
