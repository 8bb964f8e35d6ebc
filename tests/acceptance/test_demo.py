"""`mapfold demo` as a user runs it: true numbers, commands that work, nothing left behind."""

import json
import math
import os
import re
import shlex
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.system_events import COMMAND_KEY, MAP_KEY
from eventsrc.log import LogReader
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from tests.docs.console import ROOT, Command, matches, read
from tests.support.commands import Commands, Said
from tests.support.logs import simulated
from tests.support.prefork import folder_with_mapfold
from tests.support.ui_page import showing

_SPEED = 300
_DEADLINE_S = 120.0


@dataclass(frozen=True)
class Played:
    """One whole demo."""

    out: Path
    numbers: dict[str, Any]
    story: list[str]


def _demo(folder: Path, *arguments: str | Path, code: int = 0, **env: str) -> Said:
    """Run ``mapfold demo`` in ``folder``, at ten times its speed."""
    return Commands.in_folder(folder, **env)("demo", "--speed", str(_SPEED), *arguments, code=code)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Played]:
    out = tmp_path_factory.mktemp("a folder") / "demo"
    said = _demo(out.parent, "--out", out, "--json", PATH="/usr/bin:/bin")
    yield Played(out, said.json, said.err.splitlines())
    assert _processes_of(out) == []


def test_the_tour_shows_what_it_prints(played: Played) -> None:
    parts = [part for part in read(ROOT / "docs" / "tour.md") if isinstance(part, Command)]
    (shown,) = [part for part in parts if part.text == "scripts/demo"]
    printed = "\n".join(played.story)
    printed = printed.replace(f"played {_SPEED} times as fast", "played 30 times as fast")
    printed = re.sub(rf"'?{re.escape(str(played.out))}([^\s']*)'?", r"logs/demo\1", printed)
    printed = re.sub(r"\. \S*/bin/activate", ". .venv/bin/activate", printed)
    assert matches(shown.prints, printed.splitlines()), printed


def _settings(played: Played) -> Settings:
    """What the log says first."""
    with LogReader(played.out / "log") as reader:
        settings = read_corrections(reader).settings
    assert settings is not None
    assert (settings.places, settings.fusion) == ("rooms", "evidence")
    return settings


def test_every_keyframe_went_through_the_router_into_the_log(played: Played) -> None:
    run = simulated()
    with LogReader(played.out / "log") as reader:
        walls, *events = [event for event in reader.read() if event.key != COMMAND_KEY]
    assert walls.key == MAP_KEY
    assert [event.payload for event in events] == list(run.payloads)
    assert {event.key for event in events} == {"tb/detections"}
    record = played.numbers["record"]
    assert (record["published"], record["recorded"]) == (len(events), len(events))
    assert record["intact"] is True
    assert (record["rejected"], record["lost"]) == (0, 0)
    assert played.numbers["sound"] is True
    assert f"{len(events)} of {len(events)} keyframes" in "\n".join(played.story)


def test_the_reported_map_is_the_fold_of_the_log(played: Played) -> None:
    settings = _settings(played)
    with LogReader(played.out / "log") as reader:
        _, view = fold_log(reader, settings)  # without the commands
    told = played.numbers["map"]
    counts = view.counts()
    assert {name: told[name] for name in ("keyframes", "places", "objects")} == {
        name: counts[name] for name in ("keyframes", "places", "objects")
    }
    assert told["transitions"] == sum(count for _, _, count in view.edges()) > 0
    assert told["digest"] == map_digest(view) == played.numbers["replay"]["digest"]
    rows = played.numbers["replay"]["rows"]
    assert rows["Observation"] == counts["observations"]
    assert rows["ADJACENT_TO"] == counts["ADJACENT_TO"]


def test_the_tail_kept_up_and_the_replay_wrote_the_same_rows(played: Played) -> None:
    tail = played.numbers["tail"]
    assert tail["events"] == played.numbers["record"]["recorded"]
    assert 1 <= tail["batches"] <= tail["events"]
    assert 0 < tail["median_delay_s"] <= tail["worst_delay_s"] < 10
    assert played.numbers["replay"]["same_rows_as_tail"] is True


def test_the_merges_are_where_the_number_of_places_falls(played: Played) -> None:
    settings = _settings(played)
    assert played.numbers["merges"]
    with LogReader(played.out / "log") as reader:
        for merge in played.numbers["merges"]:
            _, before = fold_log(reader, settings, merge["offset"])
            _, after = fold_log(reader, settings, merge["offset"] + 1)
            absorbed = [part["place_id"] for part in merge["absorbed"]]
            names_after = {place.place_id for place in after.places.values()}
            assert len(before.places) == merge["places_before"]
            assert merge["survivor"]["place_id"] in names_after
            assert not names_after & set(absorbed)


def test_one_merge_is_undone_and_one_place_has_a_name(played: Played) -> None:
    settings = _settings(played)
    with LogReader(played.out / "log") as reader:
        corrections = read_corrections(reader)
        _, before = fold_log(reader, settings)
        _, after = fold_log(reader, settings, corrections=corrections)
    told = played.numbers["corrected"]
    assert [c["kind"] for c in told["commands"]] == ["use-settings", "undo-merge", "name-place"]
    assert told["digest"] == map_digest(after) != map_digest(before)
    assert told["places"] == len(after.places) == len(before.places) + 1
    standing = {p.place_id: p for p in after.places.values()}
    sizes = {part["place_id"]: part["keyframes"] for part in told["apart"]}
    assert {place: standing[place].keyframe_count for place in sizes} == sizes
    assert standing[told["named"]["place_id"]].name == told["named"]["room"]
    assert [p.name for p in standing.values()].count(None) == len(standing) - 1
    assert f'is called "{told["named"]["room"]}"' in "\n".join(played.story)


def test_the_error_is_the_distance_to_where_the_robot_truly_was(played: Played) -> None:
    lost = played.numbers["relocalize"]
    run = simulated(run="b")
    pose = run.true_poses[lost["keyframe_id"] - 1]
    assert lost["room"] == run.truth[lost["keyframe_id"] - 1]["room"]
    assert 1 <= len(lost["questions"]) <= 3
    for number, asked in enumerate(lost["questions"], start=1):
        assert len(asked["classes"]) == number
        found = asked["pose"]
        distance = math.dist((found["x"], found["y"]), (pose.x, pose.y))
        assert asked["error_m"] == pytest.approx(distance)
        assert f"pose {distance:.2f} m off" in "\n".join(played.story)
    every = lost["everywhere"]
    assert every["asked"] == sum(bool(envelope["detections"]) for envelope in run.envelopes)
    assert every["near"] > 0.7 * every["asked"]


def test_the_questions_hold_crops_and_no_pose(played: Played) -> None:
    for number, _ in enumerate(played.numbers["relocalize"]["questions"], start=1):
        question = json.loads((played.out / f"question-{number}.json").read_text())
        assert set(question) == {"crops"}
        assert len(question["crops"]) == number


def test_the_picture_is_there(played: Played) -> None:
    picture = played.out / "map.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert picture.stat().st_size > 50_000


@pytest.mark.slow
def test_the_commands_it_ends_with_work_as_printed(played: Played, tmp_path: Path) -> None:
    start = next(i for i, line in enumerate(played.story) if "Go on with it" in line)
    commands = [line.strip() for line in played.story[start + 1 :]]
    assert len(commands) >= 6
    assert "bin/activate" in commands[0]
    page = shlex.split(commands.pop(), comments=True)
    commands.insert(1, f"PATH={folder_with_mapfold()}:$PATH")
    script = "set -e\n" + "\n".join(commands)
    done = subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        check=False,
        timeout=_DEADLINE_S,
    )
    assert done.returncode == 0, done.stderr
    assert "undo-merge demo-undo-merge" in done.stdout  # not "no merges", as it is undone
    for asked in played.numbers["relocalize"]["questions"][:1]:
        short = asked["places"][0]["place_id"].rpartition("_")[2]
        assert re.search(rf"^\s*{short}\b", done.stdout, re.MULTILINE), done.stdout
    assert page[:2] == ["mapfold", "ui"]
    at, merge = page[page.index("--at") + 1], page[page.index("--select") + 1]
    with showing(Commands.in_folder(tmp_path), *page[2:]) as server:
        assert f"#at={at}&known=then&select={merge}" in server.said[0]
        assert server.api("why", what=merge, at=at)["merges"]


@pytest.mark.slow
def test_it_can_be_played_again_into_its_own_folder(played: Played) -> None:
    again = _demo(played.out.parent, "--out", played.out, "--seed", "3", "--json").json
    assert again["record"]["run_id"] == "sim-3-a"
    assert again["record"]["intact"] is True


def test_a_folder_that_no_demo_made_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    said = _demo(tmp_path, "--out", tmp_path, code=2)
    assert "not empty and not made by the demo" in said.err
    assert (tmp_path / "thesis.tex").read_text() == "years of work"
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.slow
def test_ended_early_it_leaves_no_process_behind(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    demo = Commands.in_folder(tmp_path).start("demo", "--speed", "1", "--out", out)
    try:
        _until(lambda: (out / "record.txt").exists() and "recording" in _read(out / "record.txt"))
        assert any("record" in command for command in _processes_of(out))
        demo.send_signal(signal.SIGTERM)
        assert demo.wait(_DEADLINE_S) != 0
        assert _processes_of(out) == []
    finally:
        demo.kill()
        demo.wait()


def _read(path: Path) -> str:
    return path.read_text("utf-8")


def _until(condition: Any) -> None:
    deadline, pause = time.monotonic() + _DEADLINE_S, threading.Event()
    while not condition():
        assert time.monotonic() < deadline
        pause.wait(0.05)


def _processes_of(out: Path) -> list[str]:
    """Command lines of running processes that name ``out``, without this one."""
    found = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            command = entry.read_bytes().replace(b"\0", b" ").decode("utf-8", "replace")
        except OSError:  # it has ended since
            continue
        if str(out) in command and int(entry.parent.name) != os.getpid():
            found.append(command)
    return found
