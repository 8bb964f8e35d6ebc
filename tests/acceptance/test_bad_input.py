"""Bad input gets one clear line with the next step, the right exit code, and loses nothing."""

import base64
import json
from pathlib import Path

import pytest

from tests.acceptance.awkward_run import awkward_payloads
from tests.support.commands import Commands
from tests.support.envelopes import detection, embedding, envelope, payload

REFUSED: list[bytes] = [
    b"not json",
    b"[1, 2]",
    payload({"run_id": "r"}),
    payload(envelope(keyframe_id=1) | {"keyframe_id": "1"}),
    payload(envelope(map_x=float("nan"))),
    payload(envelope(run_id="x" * 257)),
    payload(envelope(run_id="a\u0007")),
    payload(envelope(detections=[detection(det_id="d"), detection(det_id="d")])),
    payload(envelope(detections=[detection("cup", [1.0, 2.0], embedding_dim=3)])),
    payload(envelope(detections=[detection(**embedding([0.0, 0.0]))])),
]


@pytest.fixture
def lone(tmp_path: Path) -> Commands:
    """Commands in an empty folder, with no server running."""
    return Commands.in_folder(tmp_path)


def one_line(text: str) -> str:
    lines = text.strip().splitlines()
    assert len(lines) == 1, text
    return lines[0]


def test_every_refusal_is_kept_counted_and_gives_exit_3(lone: Commands) -> None:
    good = payload(envelope())
    stdin = b"\n".join([good, *REFUSED, b""])
    said = lone("import", "L", "-", stdin=stdin, code=3)
    assert str(len(REFUSED)) in said.err.strip().splitlines()[-1]
    events = lone("log", "cat", "L", "--json").lines
    assert [e["offset"] for e in events] == list(range(1 + len(REFUSED)))
    kept = [e["payload"] for e in events if e["key"] == "mapfold/rejected"]
    kept = [json.loads(k) if isinstance(k, str) else k for k in kept]
    assert [base64.b64decode(k["payload"]) for k in kept] == REFUSED
    assert all(k["reason"] and k["key"] == "tb/detections" for k in kept)


def test_import_of_good_input_exits_0(lone: Commands) -> None:
    lone("import", "L", "-", stdin=b"\n".join(awkward_payloads()))


def test_a_missing_log(lone: Commands) -> None:
    for command in ("state", "replay", "tail", "status"):
        said = lone(command, "nowhere", code=2)
        assert "nowhere" in one_line(said.err)
    assert "nowhere" in one_line(lone("log", "info", "nowhere", code=2).err)


def test_something_that_is_no_log(lone: Commands) -> None:
    (lone.folder / "folder").mkdir()
    (lone.folder / "folder" / "notes.txt").write_text("hello")
    (lone.folder / "file").write_text("hello")
    for name in ("folder", "file"):
        assert name in one_line(lone("state", name, code=2).err)


def test_a_database_that_is_down(lone: Commands) -> None:
    lone("import", "L", "-", stdin=payload(envelope()))
    said = lone("replay", "L", "--db", "postgresql://nobody@127.0.0.1:1/none", code=1)
    assert "127.0.0.1" in one_line(said.err)


def test_a_database_url_that_is_none(lone: Commands) -> None:
    lone("import", "L", "-", stdin=payload(envelope()))
    said = lone("replay", "L", "--db", "not a url", code=2)
    line = one_line(said.err)
    assert "--db: not a PostgreSQL URL" in line
    assert "not a url" not in line, "it may hold a password"


def test_a_missing_file(lone: Commands) -> None:
    said = lone("import", "L", "missing.jsonl", code=2)
    assert "missing.jsonl" in said.err


def test_a_point_beyond_the_log(lone: Commands) -> None:
    lone("import", "L", "-", stdin=payload(envelope()))
    for whence in ("7", "run-z:1", "yesterday", "-3"):
        said = lone("state", "L", f"--at={whence}", code=2)
        assert whence in one_line(said.err)


def test_a_recorder_without_a_router(lone: Commands) -> None:
    said = lone("record", "L", "--connect", "tcp/127.0.0.1:1", code=1)
    assert "tcp/127.0.0.1:1" in one_line(said.err)
