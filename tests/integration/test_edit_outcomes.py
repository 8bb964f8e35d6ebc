"""What `mapfold edit` refuses to record, and what it says of what it records."""

import json
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.commands import (
    CorrectPoses,
    InvalidCommand,
    RigidTransform,
    Undo,
    parse_command,
)
from eventsrc.envelope.model import KeyframeId, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogWriter
from tests.support.commands import Commands
from tests.support.fixtures_log import read_log
from tests.support.logs import EVENTS, FAR, LEFT, RIGHT, append, write_rooms

WHY = ("--reason", "why")
_OUT_OF_THE_MAP = ("correct-poses", "run-b", "--dx", "9999999.99")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    write_rooms(tmp_path / "log")
    return Commands.in_folder(tmp_path)


def _append_unobeyable(log: Path) -> int:
    return append(
        log,
        CorrectPoses(
            command_id="far",
            issued_by="raw",
            run_id=RunId("run-b"),
            transform=RigidTransform.of(1e7, 0.0, 0.0),
            first=KeyframeId(1),
        ),
    )


def test_a_command_that_no_fold_can_obey_is_not_recorded(mapfold: Commands) -> None:
    before = read_log(mapfold.folder / "log")
    digest = mapfold("state", "log", "--digest").out
    said = mapfold("edit", "log", *_OUT_OF_THE_MAP, *WHY, code=2)
    assert "correct-poses is not recorded, because the map cannot be folded with it" in said.err
    assert "beyond ±10,000,000 m" in said.err
    assert read_log(mapfold.folder / "log") == before
    assert mapfold("state", "log", "--digest").out == digest


def test_a_fold_that_a_command_stops_names_it_and_its_undo_is_recorded(mapfold: Commands) -> None:
    digest = mapfold("state", "log", "--digest").out
    assert _append_unobeyable(mapfold.folder / "log") == EVENTS
    said = mapfold("state", "log", code=1)
    assert f"correct-poses far at offset {EVENTS} moves keyframe 1 of run" in said.err
    assert "mapfold edit LOG undo far --reason" in said.err
    said = mapfold("edit", "log", "undo", "far", *WHY, "--command-id", "u")
    assert said.out.startswith(f"undo recorded at offset {EVENTS + 1}, command u; ")
    assert "its effect is not known: " in said.out
    assert mapfold("state", "log", "--digest", "--at", str(EVENTS)).out == digest
    said = mapfold("edit", "log", "undo", "u", *WHY, code=2)
    assert "undo is not recorded" in said.err


def test_json_of_an_unknown_effect_has_offset_id_and_reason(mapfold: Commands) -> None:
    _append_unobeyable(mapfold.folder / "log")
    said = mapfold("edit", "log", "undo", "far", *WHY, "--command-id", "u", "--json").json
    assert (said["offset"], said["command_id"], said["effect"]) == (EVENTS + 1, "u", None)
    assert "beyond" in said["effect_unknown"]


def test_keyframes_that_cannot_be_parted_are_refused(mapfold: Commands) -> None:
    before = read_log(mapfold.folder / "log")
    said = mapfold("edit", "log", "keep-apart", "run-a:0", "run-a:1", *WHY, code=2)
    assert "keep-apart would not part run-a:0 and run-a:1: both would be in" in said.err
    assert "ε/√2" in said.err
    assert read_log(mapfold.folder / "log") == before
    mapfold("edit", "log", "keep-apart", LEFT, FAR, *WHY)  # two already: it refuses later merges
    mapfold("edit", "log", "keep-apart", LEFT, RIGHT, *WHY)


def test_commands_that_lose_their_effect_are_named(mapfold: Commands) -> None:
    mapfold("edit", "log", "name-place", FAR, "shed", *WHY, "--command-id", "n")
    said = mapfold("edit", "log", "forget-run", "run-b", *WHY)
    assert f"command n (name-place at offset {EVENTS}" in said.err
    assert "has no effect any more: its keyframe run-b:" in said.err
    assert "is left out" in said.err
    assert "no effect" not in mapfold("edit", "log", "name-place", LEFT, "hall", *WHY).err


_HEAD = {"command_id": "c", "issued_by": "raw"}
_TURN = {"dx": 0.0, "dy": 0.0, "dyaw": 0.0, "cos": 1.0, "sin": 0.0}


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"poses": [{"keyframe_id": 1, "x": 0.0, "y": 0.0, "yaw": 10_001.0}]}, "yaw"),
        ({"transform": _TURN | {"cos": 0.5}}, "cos² + sin² must be 1"),
        ({"transform": _TURN | {"cos": 0.0, "sin": 1.0}}, "must be those of dyaw"),
        ({"transform": _TURN | {"dyaw": 1e9}}, "dyaw"),
        ({"transform": _TURN, "first": 3, "last": 2}, "first must not be more than last"),
    ],
)
def test_a_correction_of_poses_out_of_bounds_is_no_command(
    fields: dict[str, Any], says: str
) -> None:
    document = {**_HEAD, "kind": "correct-poses", "run_id": "run-b"}
    assert parse_command(json.dumps(document | {"transform": _TURN}).encode())
    with pytest.raises(InvalidCommand, match=says.replace("²", ".").replace("+", ".")):
        parse_command(json.dumps(document | fields).encode())


def test_a_range_that_ends_before_it_begins_is_no_command() -> None:
    document = {**_HEAD, "kind": "forget-keyframes", "run_id": "run-b", "first": 2}
    assert parse_command(json.dumps(document | {"last": 2}).encode())
    with pytest.raises(InvalidCommand, match="first must not be more than last"):
        parse_command(json.dumps(document | {"last": 1}).encode())


def test_a_place_is_named_by_its_name_unless_two_have_it(mapfold: Commands) -> None:
    mapfold("edit", "log", "name-place", LEFT, "hall", *WHY)
    said = mapfold("edit", "log", "join", "hall", FAR, "--dry-run", "--json").json
    assert said["command"]["places"][0] == {"run_id": "run-a", "keyframe_id": 0}
    mapfold("edit", "log", "name-place", FAR, "hall", *WHY)
    said = mapfold("edit", "log", "join", "hall", FAR, *WHY, code=2)
    assert f"'hall' means 2 places; give the id of one:\n  {LEFT} (hall, " in said.err
    assert f"\n  {FAR} (hall, " in said.err


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("  ", "blank"),
        ("a\u202eb", "(category Cf)"),
        ("a\u200bb", "(category Cf)"),
        (RIGHT, "is the id of a place"),
    ],
)
def test_names_that_cannot_be_told_apart_are_refused(
    mapfold: Commands, name: str, says: str
) -> None:
    assert says in mapfold("edit", "log", "name-place", LEFT, name, *WHY, code=2).err


@pytest.mark.parametrize("span", ["1..\u0663", "1_0..2_0"])
def test_numbers_are_ascii_digits(mapfold: Commands, span: str) -> None:
    said = mapfold("edit", "log", "forget-keyframes", "run-a", span, *WHY, code=2)
    assert "is no range of keyframes" in said.err
    said = mapfold("edit", "log", "join", "run-a:\u0661", FAR, *WHY, code=2)
    assert "no keyframe" in said.err


def test_a_second_command_of_an_id_is_marked_and_found_by_verify(mapfold: Commands) -> None:
    log = mapfold.folder / "log"
    mapfold("edit", "log", "forget-run", "run-b", *WHY, "--command-id", "c")
    assert mapfold("log", "verify", "log").code == 0
    _append_unobeyable(log)
    first = read_log(log)[EVENTS]
    with LogWriter(log) as writer:
        writer.append(COMMAND_KEY, first.payload)
        writer.append(COMMAND_KEY, first.payload.replace(b"run-b", b"run-a"))
    said = mapfold("log", "verify", "log", code=None)
    assert f"has the id of another one, at offset {EVENTS}" in said.out + said.err
    found = mapfold("edits", "log", "--json").json
    assert [each.get("repeats") for each in found] == [None, None, EVENTS, EVENTS]
    assert f"not counted: its id is that of {EVENTS}" in mapfold("edits", "log").out


def test_an_undo_before_its_command_undoes_nothing(mapfold: Commands) -> None:
    append(mapfold.folder / "log", Undo(command_id="u", issued_by="raw", undone="c"))
    mapfold("edit", "log", "forget-run", "run-b", *WHY, "--command-id", "c")
    assert [e["undone_by"] for e in mapfold("edits", "log", "--json").json] == [None, None]
    mapfold("edit", "log", "undo", "c", *WHY, "--command-id", "v")
    assert [e["undone_by"] for e in mapfold("edits", "log", "--json").json] == [None, "v", None]


def test_a_command_of_an_unknown_kind_is_named_with_a_next_step(mapfold: Commands) -> None:
    digest = mapfold("state", "log", "--digest").out
    with LogWriter(mapfold.folder / "log") as writer:
        writer.append(COMMAND_KEY, b'{"kind": "zz"}')
    said = mapfold("state", "log", code=1).err
    assert "it is a command of kind 'zz', which this version does not know; update mapfold" in said
    assert f"`mapfold state --at {EVENTS} log`" in said
    assert mapfold("state", "log", "--at", str(EVENTS), "--digest").out == digest
