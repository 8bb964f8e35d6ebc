"""`mapfold edit` and `mapfold edits` on a log that no other process has locked."""

import getpass
import json
import os
import random
import signal
import socket
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.commands import Command, NamePlace, parse_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from projections.edit.current import MapToEdit
from projections.edit.effect import Change, Effect, effect_of
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from tests.support.commands import Commands
from tests.support.fixtures_log import flip, read_log
from tests.support.logs import EVENTS, FAR, LEFT, MERGE, RIGHT, walk, write_rooms
from tests.support.thorough import every_other, mostly_slow, rounds, stride
from tests.support.walks import write_damaged_log

WHY = ("--reason", "why")


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    write_rooms(tmp_path / "log")
    return Commands.in_folder(tmp_path)


def _commands(log: Path) -> list[Command]:
    with LogReader(log) as reader:
        return [parse_command(e.payload) for e in reader.read(keys={COMMAND_KEY})]


def _files(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.iterdir())}


def _digest(mapfold: Commands, *args: str) -> str:
    return mapfold("state", "log", "--digest", *args).out


def test_a_command_is_an_event_with_author_reason_and_effect(mapfold: Commands) -> None:
    said = mapfold("edit", "log", "name-place", LEFT, "hall", *WHY, "--command-id", "c1")
    assert said.out == (
        "name-place recorded at offset 30, command c1; changes 1 place, 0 objects, 0 keyframes\n"
    )
    (command,) = _commands(mapfold.folder / "log")
    assert isinstance(command, NamePlace)
    assert command.issued_by == f"{getpass.getuser()}@{socket.gethostname()}"
    assert (command.reason, command.name, command.place.keyframe_id) == ("why", "hall", 0)


def test_json_has_offset_id_and_effect(mapfold: Commands) -> None:
    said = mapfold("edit", "log", "forget-run", "run-b", *WHY, "--json").json
    assert said["offset"] == EVENTS
    assert said["effect"] == {"places": 1, "objects": 0, "keyframes": 5}
    assert _commands(mapfold.folder / "log")[0].command_id == said["command_id"]
    assert said["repeated"] is False


KINDS: Sequence[tuple[str, ...]] = [
    ("name-place", LEFT, "hall"),
    ("keep-apart", LEFT, RIGHT),
    ("undo-merge", str(MERGE)),
    ("join", LEFT, FAR),
    ("same-object", "cup-1", "cup-3"),
    ("different-objects", "cup-1", "cup-2"),
    ("drop-object", "obj-36156c6b0fcc3c5d"),
    ("drop-detection", "cup-1", "bare"),
    ("forget-run", "run-b"),
    ("forget-keyframes", "run-a", "2..4"),
    ("correct-poses", "run-b", "--dx", "-0.5", "--dyaw", "0.1", "--from", "1"),
    ("use-settings", "--set", "min_samples=6"),
    ("relabel", "cup=mug"),
]


@pytest.mark.parametrize("kind", KINDS[:: stride(4)], ids=lambda kind: kind[0])
def test_undone_the_map_is_what_it_was(mapfold: Commands, kind: tuple[str, ...]) -> None:
    log = mapfold.folder / "log"
    before, digest = _files(log), _digest(mapfold)
    dry = mapfold("edit", "log", *kind, "--dry-run", "--json").json
    assert _files(log) == before, "a dry run writes nothing"
    given = mapfold("edit", "log", *kind, *WHY, "--json").json
    assert given["effect"] == dry["effect"]
    assert dry["offset"] is None
    assert dry["difference"]["digests"][0] == digest.strip()
    assert dry["difference"]["digests"][1] == _digest(mapfold).strip() != digest.strip()
    mapfold("edit", "log", "undo", given["command_id"], *WHY)
    assert _digest(mapfold, "--at", str(EVENTS)) == digest
    assert [c.kind for c in _commands(log)] == [kind[0], "undo"]


def test_a_dry_run_says_what_would_change(mapfold: Commands) -> None:
    said = mapfold("edit", "log", "forget-run", "run-b", "--dry-run").out
    assert said.splitlines()[0] == (
        "forget-run would change 1 place, 0 objects, 5 keyframes; nothing is recorded"
    )
    assert "keyframes  5 gone" in said
    assert f"- {FAR} (5 keyframes)" in said


def test_a_trajectory_file_moves_what_it_names(mapfold: Commands) -> None:
    lines = "".join(f"{1774357200 + k} {k / 2 + 0.25} 20.5 0 0 0 0 1\n" for k in range(1, 5))
    (mapfold.folder / "poses.tum").write_text(lines)
    said = mapfold("edit", "log", "correct-poses", "run-b", "poses.tum", *WHY)
    assert "changes 1 place, 0 objects, 4 keyframes" in said.out
    assert (
        "1 keyframe left without correction, more than --slack 0.05 s outside its stamps: run-b:0"
        in said.err
    )
    keyframes = mapfold("state", "log", "--json").json["keyframes"]
    moved = {
        k["keyframe_id"]: (k["map_x"], k["map_y"]) for k in keyframes if k["run_id"] == "run-b"
    }
    assert moved == {0: (0.0, 20.0)} | {k: (k / 2 + 0.25, 20.5) for k in range(1, 5)}


def test_a_name_needs_no_reason(mapfold: Commands) -> None:
    mapfold("edit", "log", "name-place", LEFT, "hall")
    (command,) = _commands(mapfold.folder / "log")
    assert command.reason == ""
    assert mapfold("edits", "log", "--json").json[0]["reason"] == ""
    assert "name-place" in mapfold("edits", "log").out


def test_what_is_wrong_is_one_line_and_writes_nothing(mapfold: Commands) -> None:
    log = mapfold.folder / "log"
    before = _files(log)
    (mapfold.folder / "cut.tum").write_text("1774357200 1 2 0 0")
    wrong: Sequence[tuple[tuple[str, ...], str]] = [
        (("join", LEFT, "run-a_p9", *WHY), "no place 'run-a_p9'"),
        (("join", LEFT, FAR), "--reason TEXT is missing"),
        (("join", LEFT, FAR, "--reason", " "), "--reason TEXT is missing"),
        (
            ("join", LEFT, FAR, "--reason", "x" * 2_001),
            "--reason is 2001 characters long",
        ),
        (("join", LEFT, FAR, *WHY, "--issued-by", ""), "--issued-by is empty"),
        (("join", LEFT, FAR, *WHY, "--command-id", "a\tb"), "--command-id has the control"),
        (("undo-merge", "3", *WHY), "nothing merged at offset 3"),
        (("correct-poses", "run-b", *WHY), "give either FILE or some of --dx"),
        (("correct-poses", "run-b", "cut.tum", "--dx", "1", *WHY), "give either FILE or some of"),
        (("correct-poses", "run-b", "cut.tum", *WHY), "cut.tum, line 1: 5 numbers instead of 8"),
        (("correct-poses", "run-b", "none.tum", *WHY), "none.tum: No such file or directory"),
        (("use-settings", *WHY), "give FILE, --preset NAME or --set NAME=VALUE"),
        (("use-settings", "--set", "eps=1", *WHY), "--set eps=1: no setting 'eps'"),
        (("use-settings", "cut.tum", *WHY), "not JSON"),
        (("undo", "c9", *WHY), "no command 'c9' in this log; there is no command at all"),
    ]
    for args, says in every_other(wrong):
        said = mapfold("edit", "log", *args, code=2)
        (line,) = said.err.splitlines()
        assert says in line, line
    assert mapfold("edit", "nowhere", "undo", "x", *WHY, code=2).err.startswith(
        "mapfold: no log at"
    )
    assert not (mapfold.folder / "nowhere").exists()
    assert _files(log) == before


def test_the_same_id_twice_is_recorded_once(mapfold: Commands) -> None:
    """A retry after a try that may or may not have been recorded."""
    give = ("edit", "log", "name-place", LEFT, "hall", *WHY, "--command-id", "c1", "--json")
    first, again = mapfold(*give).json, mapfold(*give).json
    assert (first["offset"], again["offset"]) == (EVENTS, EVENTS)
    assert (first["repeated"], again["repeated"]) == (False, True)
    assert first["effect"] == again["effect"]
    said = mapfold("edit", "log", "name-place", LEFT, "bath", *WHY, "--command-id", "c1", code=2)
    assert "--command-id c1 is that of another command, at offset 30" in said.err
    assert len(_commands(mapfold.folder / "log")) == 1


def test_control_characters_in_a_reason_are_kept_and_printed_as_escapes(
    mapfold: Commands,
) -> None:
    reason = "bell \x07 \x1b]0;title\x07 \u202e\nforged line"
    mapfold("edit", "log", "name-place", LEFT, "hall", "--reason", reason)
    for args in (("edits", "log"), ("edits", "log", "--json"), ("edits", "log", "--effects")):
        said = mapfold(*args).out
        assert all(c.isprintable() or c == "\n" for c in said)
    assert mapfold("edits", "log", "--json").json[0]["reason"] == reason
    assert _commands(mapfold.folder / "log")[0].reason == reason
    assert "\nforged line" not in mapfold("edits", "log").out


def test_an_argument_that_is_no_text_is_refused(mapfold: Commands) -> None:
    said = mapfold("edit", "log", "name-place", LEFT, os.fsdecode(b"\xff"), *WHY, code=2)
    assert "name" in said.err
    assert _commands(mapfold.folder / "log") == []


def test_a_damaged_log_is_left_as_it_is(tmp_path: Path) -> None:
    write_damaged_log(tmp_path / "log", walk(20))
    mapfold = Commands.in_folder(tmp_path)
    before = _files(tmp_path / "log")
    said = mapfold("edit", "log", "forget-run", "run-a", *WHY, code=1)
    assert "cannot be folded" in said.err
    assert _files(tmp_path / "log") == before


@pytest.mark.parametrize("part", [2, 3])
def test_a_log_with_a_flipped_bit_is_left_as_it_is(mapfold: Commands, part: int) -> None:
    log = mapfold.folder / "log"
    (segment,) = log.glob("*.mcap")
    whole = segment.read_bytes()
    compressed = whole.index(b"\x28\xb5\x2f\xfd")  # zstd's magic: the chunk with the events
    flip(segment, compressed + (len(whole) - compressed) // (2 * part))
    with pytest.raises(LogDamaged):
        read_log(log)
    before = _files(log)
    said = mapfold("edit", "log", "forget-run", "run-b", *WHY, code=1)
    assert "mapfold log verify" in said.err
    assert _files(log) == before


def test_verify_finds_an_event_that_is_no_command(mapfold: Commands) -> None:
    mapfold("edit", "log", "forget-run", "run-b", *WHY)
    assert mapfold("log", "verify", "log").code == 0
    with LogWriter(mapfold.folder / "log") as writer:
        writer.append(COMMAND_KEY, b'{"kind": "forget-run"}')
    said = mapfold("log", "verify", "log", code=None)
    assert said.code != 0
    assert "mapfold/command event cannot be read: forget-run.command_id" in said.out + said.err


def test_an_import_does_not_bring_commands(mapfold: Commands) -> None:
    mapfold("edit", "log", "forget-run", "run-b", *WHY)
    said = mapfold("import", "other", "log", code=3)
    assert "1 rejected" in said.out + said.err
    assert _commands(mapfold.folder / "other") == []
    assert mapfold("state", "other", "--json").json["counts"]["keyframes"] == EVENTS


def test_an_event_that_is_no_command_stops_edits_with_its_offset(mapfold: Commands) -> None:
    with LogWriter(mapfold.folder / "log") as writer:
        writer.append(COMMAND_KEY, b'{"kind": "\x1b[2J"}')
    for args in (("edit", "log", "undo", "x", *WHY), ("edits", "log")):
        said = mapfold(*args, code=1)
        assert f"event at offset {EVENTS} cannot be folded" in said.err
        assert "\x1b" not in said.err


def test_edits_at_once_are_all_recorded_and_none_twice(mapfold: Commands) -> None:
    """They exclude one another by the log's lock. One that finds it held by another edit tries
    again, and if it is held still, says so."""
    names = [f"name-{n}" for n in range(rounds(6, 4))]

    def give(name: str) -> int:
        for _ in range(50):
            said = mapfold(
                "edit", "log", "name-place", LEFT, name, *WHY, "--command-id", name, code=None
            )
            if said.code == 0:
                return said.code
            assert "is being written by" in said.err, said.err
        return 1

    with ThreadPoolExecutor(3) as threads:
        assert list(threads.map(give, names)) == [0] * len(names)
    assert sorted(c.command_id for c in _commands(mapfold.folder / "log")) == names


def test_a_command_recorded_meanwhile_is_seen(
    mapfold: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between making a command and taking the lock another one comes: the command is made again."""
    from projections.edit import make, record

    log = mapfold.folder / "log"
    made = []

    def join(current: MapToEdit, stamp: make.Stamp) -> Command:
        made.append(current.known_at)
        if len(made) == 1:
            mapfold("edit", "log", "keep-apart", LEFT, FAR, *WHY)
        return make.join(current, stamp, LEFT, FAR)

    def no_session() -> Any:
        raise AssertionError("the log is free")

    stamp = make.Stamp("mine", "me@here", "why")
    with pytest.raises(Exception, match="these places are kept apart by"):
        record.record_command(log, join, stamp, lambda c: c.settings or Settings(), no_session)
    assert made == [0, EVENTS + 1]
    assert [c.kind for c in _commands(log)] == ["keep-apart"]


@pytest.mark.parametrize("seed", mostly_slow(range(0, 4, stride(2))))
def test_killed_at_any_moment_it_is_recorded_once_or_not_at_all(
    mapfold: Commands, seed: int
) -> None:
    rng = random.Random(seed)
    log, ids = mapfold.folder / "log", []
    whole_s = mapfold.seconds("edit", "log", "name-place", LEFT, "n", *WHY, "--dry-run")
    for number in range(rounds(4, 2)):
        ids.append(f"c{number}")
        give = ["edit", "log", "name-place", LEFT, f"n{number}", *WHY, "--command-id", ids[-1]]
        process = mapfold.start(*give)
        killer = threading.Timer(rng.uniform(0.0, whole_s), process.send_signal, [signal.SIGKILL])
        killer.start()
        process.wait()
        killer.cancel()
        recorded = [c.command_id for c in _commands(log)]
        assert recorded in (ids, ids[:-1])
        mapfold(*give)  # again, as one would who does not know
        assert [c.command_id for c in _commands(log)] == ids
    assert mapfold("log", "verify", "log", code=None).code in (0, 3)
    assert mapfold("state", "log", "--json").json["counts"]["places"] == 2


def test_edits_lists_who_when_why_what_and_what_undid_it(mapfold: Commands) -> None:
    assert mapfold("edits", "log").out == "no command in this log; `mapfold edit log` records one\n"
    assert mapfold("edits", "log", "--json").json == []
    for args in (
        ("forget-run", "run-b", "--command-id", "c1", "--issued-by", "ann@lab"),
        ("name-place", LEFT, "hall", "--command-id", "c2", "--issued-by", "bob@lab"),
        ("undo", "c1", "--command-id", "c3", "--issued-by", "ann@lab"),
    ):
        mapfold("edit", "log", *args, *WHY)
    found = mapfold("edits", "log", "--json").json
    assert [(e["offset"], e["kind"], e["what"], e["issued_by"], e["undone_by"]) for e in found] == [
        (30, "forget-run", "run-b", "ann@lab", "c3"),
        (31, "name-place", "run-a:0 is hall", "bob@lab", None),
        (32, "undo", "c1", "ann@lab", None),
    ]
    assert [e["effect"] for e in found] == [
        {"places": 1, "objects": 0, "keyframes": 5},
        {"places": 1, "objects": 0, "keyframes": 0},
        {"places": 1, "objects": 0, "keyframes": 5},
    ]
    text = mapfold("edits", "log").out.splitlines()
    assert len(text) == 4
    assert "undone by c3" in text[1]


def test_effects_that_are_not_known_are_worked_out_when_asked(mapfold: Commands) -> None:
    for args in (("forget-run", "run-b"), ("name-place", LEFT, "hall"), ("undo-merge", "20")):
        mapfold("edit", "log", *args, *WHY)
    known = mapfold("edits", "log", "--json").json
    cache = mapfold.folder / "log.history" / "effects.json"
    damages = [None, b"", b"{", b'{"version":1}', b"[]", os.urandom(100), b"[" * 9_999]
    for damage in damages[:: stride(3)]:
        cache.unlink() if damage is None else cache.write_bytes(damage)
        assert [e["effect"] for e in mapfold("edits", "log", "--json").json] == [None] * 3
    assert "not computed" in mapfold("edits", "log").out
    assert mapfold("edits", "log", "--json", "--effects").json == known
    assert mapfold("edits", "log", "--json").json == known
    other = mapfold("edits", "log", "--json", "--set", "eps_m=1.0").json
    assert [e["effect"] for e in other] == [None] * 3, "those of other settings are not these"


@pytest.mark.parametrize("kind", KINDS[stride(2) - 1 :: stride(2)], ids=lambda kind: kind[0])
def test_the_effect_is_that_of_two_whole_folds(mapfold: Commands, kind: tuple[str, ...]) -> None:
    """Also for names, which are compared without a fold."""
    mapfold("edit", "log", "name-place", RIGHT, "bath", *WHY)
    given = mapfold("edit", "log", *kind, *WHY, "--json").json
    maps = []
    with LogReader(mapfold.folder / "log") as reader:
        for known_at in (EVENTS + 1, EVENTS + 2):
            corrections = read_corrections(reader, known_at)
            settings = corrections.settings or Settings()
            maps.append(fold_log(reader, settings, corrections=corrections)[1])
    assert effect_of(*maps) == Effect(**given["effect"])


def test_a_cache_that_cannot_be_written_is_noted_and_fails_nothing(mapfold: Commands) -> None:
    (mapfold.folder / "log.history").write_text("a file where a folder should be")
    done = mapfold("edit", "log", "forget-run", "run-b", *WHY)
    assert "effects.json: no effect was kept: File exists" in done.err
    assert mapfold("edits", "log", "--json").json[0]["effect"] is None


def test_effects_of_another_log_are_not_taken(mapfold: Commands) -> None:
    mapfold("edit", "log", "forget-run", "run-b", *WHY)
    path = mapfold.folder / "log.history" / "effects.json"
    document = json.loads(path.read_text())
    path.write_text(json.dumps({**document, "log_id": "another"}))
    assert mapfold("edits", "log", "--json").json[0]["effect"] is None


def test_a_change_that_is_none_is_folded_no_second_time(mapfold: Commands) -> None:
    with LogReader(mapfold.folder / "log") as reader:
        current = MapToEdit(reader, lambda _: Settings())
        change = Change(current, current.commands)
        assert change.effect().none
        assert change.after is current.view
