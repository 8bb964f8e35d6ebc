"""`mapfold calibrate` on logs: what it prints, records, and what the next fold does with it."""

import json
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader, LogWriter
from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import Settings
from projections.localize.calibrate.rounds import calibrate
from projections.map.parsing import read_corrections
from tests.support.commands import Commands
from tests.support.envelopes import envelope
from tests.support.fixtures_zenoh import Program
from tests.support.logs import walk, write_log
from tests.support.seen_rooms import BEARING_RAD, SIZES, drive, write_room
from tests.support.thorough import mostly_slow, rounds

BY_EVIDENCE = ("--set", "fusion=evidence")
COUNT = rounds(80, 30)
SIZED = ("--set", "camera.width_px=800", "--set", "camera.height_px=600")
"""Keyframes of each of the two runs; a calibration costs three seconds with 80."""


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    write_room(tmp_path / "log", count=COUNT)
    return Commands.in_folder(tmp_path)


def _by_name(document: Any) -> dict[str, dict[str, Any]]:
    return {each["name"]: each for each in document["constants"]}


def _settings(log: Path) -> Settings:
    with LogReader(log) as reader:
        return read_corrections(reader).settings or Settings()


@pytest.mark.slow
def test_constants_are_printed_with_their_priors_and_what_they_rest_on(mapfold: Commands) -> None:
    said = mapfold("calibrate", "log")
    first, header, *rest = said.out.splitlines()
    assert first.startswith(f"{2 * COUNT} keyframes with a pose, ")
    assert "6 things with bearings that cross well, seen " in first
    assert header.split() == ["evidence.", "value", "prior", "this", "map", "rests", "on"]
    rows = {line.split()[0]: line for line in rest}
    assert rows["bearing_rad"].endswith(" observations")
    assert rows["sizes_m.lamp"].endswith(" whole boxes")
    assert rows["sizes_m.lamp"].split()[2] == "-"
    assert rest[-1].startswith("the map is folded with fusion=page")
    full = "`mapfold edit log use-settings --preset full --reason WHY` makes places rooms and fuses"
    assert full in rest[-1]
    assert "hint" not in said.err
    assert mapfold("edits", "log", "--json").json == []


@pytest.mark.slow
def test_json_names_constants_as_set_takes_them(mapfold: Commands) -> None:
    found = mapfold("calibrate", "log", "--json", *BY_EVIDENCE).json
    assert (found["keyframes"], found["things"], found["runs"]) == (2 * COUNT, 6, 2)
    assert (found["fusion"], found["recorded"], found["hints"]) == ("evidence", None, [])
    named = _by_name(found)
    assert named["evidence.bearing_rad"]["prior"] == EvidenceConstants().bearing_rad
    assert named["evidence.bearing_rad"]["seen"] == pytest.approx(BEARING_RAD, abs=0.012)
    for name, size in SIZES.items():
        assert named[f"evidence.sizes_m.{name}"]["value"] == pytest.approx(size, rel=0.1)
    given = [f"{n}={e['value']}" for n, e in named.items() if e["value"] is not None]
    taken = Settings(fusion="evidence").with_assignments(given)
    assert taken.evidence.sizes_m["lamp"] == named["evidence.sizes_m.lamp"]["value"]


@pytest.mark.slow
def test_the_same_log_gives_the_same_answer(mapfold: Commands) -> None:
    assert mapfold("calibrate", "log", "--json").out == mapfold("calibrate", "log", "--json").out


@pytest.mark.slow
def test_written_constants_are_in_every_fold_and_can_be_undone(mapfold: Commands) -> None:
    log = mapfold.folder / "log"
    before = mapfold("state", "log", "--json").json["settings"]
    mapfold("edit", "log", "use-settings", "--set", "eps_m=0.9", *BY_EVIDENCE, "--reason", "why")
    evidence = mapfold("state", "log", "--json").json["settings"]
    read = mapfold("calibrate", "log", "--json").json
    said = mapfold("calibrate", "log", "--write", "--json").json
    assert said["constants"] == read["constants"]
    assert said["recorded"]["offset"] == 2 * COUNT + 1
    settings = _settings(log)
    assert (settings.eps_m, settings.fusion) == (0.9, "evidence")
    named = _by_name(said)
    assert (
        settings.evidence.range_m
        == named["evidence.range_m"]["value"]
        != EvidenceConstants().range_m
    )
    assert set(settings.evidence.sizes_m) == set(SIZES)
    calibrated = mapfold("state", "log", "--json").json["settings"]
    assert len({json.dumps(each) for each in (before, evidence, calibrated)}) == 3
    listed = mapfold("edits", "log", "--json").json[-1]
    assert listed["reason"].startswith("calibrated: 6 things seen ")
    undo = ("undo", said["recorded"]["command_id"], "--reason", "no")
    mapfold("edit", "log", *undo)
    assert mapfold("state", "log", "--json").json["settings"] == evidence
    assert _settings(log).evidence == EvidenceConstants()


@pytest.mark.slow
def test_the_map_says_how_it_would_do_and_a_second_write_records_nothing(
    mapfold: Commands,
) -> None:
    first = mapfold("calibrate", "log", "--write", "--json", *BY_EVIDENCE).json
    own = first["localiser"]
    for crops in ("1", "3"):
        scores = own["questions"][crops]
        assert scores["known"] <= scores["questions"] / 2 <= 100
        assert scores["known_called_unknown"] <= 0.1
        assert scores["pose_error_m"]["p50"] < scores["plain"]["pose_error_m"]["p50"]
    recorded = _settings(mapfold.folder / "log").localizer.model_dump()
    named = {f"localizer.{name}": value for name, value in recorded.items()}
    assert {name: named[name] for name in own["constants"]} == own["constants"]
    assert named["localizer.known_count"] > 200
    assert named["localizer.known_scale"] != 1.0
    second = mapfold("calibrate", "log", "--write").out
    assert second.endswith("the log has these constants already; nothing is recorded\n")
    lines = second.splitlines()
    start = next(n for n, line in enumerate(lines) if line.startswith("re-localisation  asked"))
    assert [line.split()[0] for line in lines[start + 1 : start + 6]] == [
        "1", "3", "right,", "known", "confidence",
    ]  # fmt: skip
    reset = mapfold("calibrate", "log", "--json", "--set", "localizer.known_shift=5.0").json
    assert reset["localiser"]["constants"] == own["constants"]  # the one in force plays no part
    assert reset["constants"] == first["constants"]
    assert first["recorded"]["offset"] == 2 * COUNT
    assert len(mapfold("edits", "log", "--json").json) == 1


@pytest.mark.slow
def test_write_with_set_switches_the_rule_in_one_command(mapfold: Commands) -> None:
    said = mapfold("calibrate", "log", "--write", *BY_EVIDENCE, "--reason", "try it").out
    assert "folded with fusion=page" not in said
    assert f"use-settings recorded at offset {2 * COUNT}, command " in said.splitlines()[-1]
    settings = _settings(mapfold.folder / "log")
    assert (settings.fusion, settings.evidence.range_m != EvidenceConstants().range_m) == (
        "evidence",
        True,
    )
    assert mapfold("edits", "log", "--json").json[0]["reason"] == "try it"
    listed = mapfold("edits", "log").out
    assert re.search(
        r"use-settings fusion=evidence, \d+ constants of evidence, 6 constants of localizer  ",
        listed,
    )


def test_what_is_in_the_log_already_is_not_recorded_again(tmp_path: Path) -> None:
    write_log(tmp_path / "log", [envelope(k, 0.1 * k) for k in range(3)])
    said = Commands.in_folder(tmp_path)("calibrate", "log", "--write")
    assert said.out.splitlines()[-1] == "the log has these constants already; nothing is recorded"
    with LogReader(tmp_path / "log") as reader:
        assert reader.next_offset == 3


@pytest.mark.slow
def test_the_camera_of_the_settings_serves_where_envelopes_state_none(tmp_path: Path) -> None:
    write_room(tmp_path / "stated")
    write_room(tmp_path / "log", camera=False)
    mapfold = Commands.in_folder(tmp_path)
    camera = ("hfov_deg=90", "width_px=800", "height_px=600")
    given = [word for each in camera for word in ("--set", f"camera.{each}")]
    found = mapfold("calibrate", "log", "--json", *given).json
    assert found["constants"] == mapfold("calibrate", "stated", "--json").json["constants"]
    wrong = mapfold("calibrate", "log", "--set", "camera.hfov_deg=90").out
    assert "beyond the picture of 640 × 400 pixels: give the camera" in wrong


@pytest.mark.slow
def test_a_camera_that_nothing_states_is_estimated_and_recorded(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=COUNT, camera=False)
    mapfold = Commands.in_folder(tmp_path)
    tried = mapfold("calibrate", "log", *BY_EVIDENCE)
    assert "field of view" in tried.out
    told = "`mapfold calibrate log --write --set fusion=evidence` records the camera and the"
    assert told in tried.err
    counts = mapfold("state", "log", "--json", *BY_EVIDENCE).json["counts"]
    assert 0 < counts["without_camera"] <= 2 * COUNT
    assert "without_camera" not in mapfold("state", "log", "--json").json["counts"]

    said = mapfold("calibrate", "log", "--write", "--json", *BY_EVIDENCE, *SIZED).json
    camera = said["camera"]
    assert camera["hfov_deg"] == pytest.approx(90.0, abs=4.0)
    assert abs(camera["hfov_deg"] - 90.0) < 4.0 * camera["hfov_error_deg"] + 0.5
    assert (camera["size_from"], camera["width_px"], camera["things"]) == ("settings", 800.0, 6)
    recorded = _settings(tmp_path / "log").camera
    assert (recorded.hfov_deg, recorded.height_px) == (camera["hfov_deg"], 600.0)
    after = mapfold("state", "log")
    assert f"camera.hfov_deg={camera['hfov_deg']}" in after.out
    answer = mapfold("relocalize", "--class", "lamp", "--log", "log", "--hfov", "90")
    assert "no camera is stated" not in answer.err


@pytest.mark.slow
def test_an_estimated_camera_is_not_recorded_again(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=COUNT, camera=False)
    mapfold = Commands.in_folder(tmp_path)
    camera = mapfold("calibrate", "log", "--write", "--json", *BY_EVIDENCE, *SIZED).json["camera"]
    again = mapfold("calibrate", "log", "--write").out
    assert f"field of view {camera['hfov_deg']:g}° ± {camera['hfov_error_deg']:g}°" in again
    assert again.endswith("the log has these constants already; nothing is recorded\n")


def test_relocalize_names_the_camera_that_only_the_question_states(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=20, camera=False)
    write_room(tmp_path / "stated", count=20)
    mapfold = Commands.in_folder(tmp_path)
    for log, is_named in (("log", True), ("stated", False)):
        asked = ("relocalize", "--class", "lamp", "--log", log, *BY_EVIDENCE)
        said = mapfold(*asked, "--hfov", "90")
        assert ("keyframes of the map, as it is for the question" in said.err) is is_named
        assert "no camera is stated" not in mapfold(*asked).err


@pytest.mark.slow
def test_a_camera_that_is_stated_is_not_estimated(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=20, camera=False)
    write_room(tmp_path / "stated", count=20)
    mapfold = Commands.in_folder(tmp_path)
    few = mapfold("calibrate", "log", "--set", "camera.hfov_deg=none").out
    assert "field of view" in few
    stated = mapfold("calibrate", "stated", "--json").json
    assert stated["camera"] is None


THIN: dict[str, tuple[list[dict[str, Any]], str]] = {
    "empty": ([], "no observation with a pose is of an object: all constants are priors"),
    "no poses": ([envelope(k, None) for k in range(5)], "all constants are priors"),
    "no revisits": (walk(40, detections=1), "nothing was seen three times from spots 0.8 m apart"),
    "no detections": ([envelope(k, 0.1 * k) for k in range(5)], "all constants are priors"),
    "one run": (drive(4, "run-a", 60), "one run: session_shift, the loss of likeness"),
}


@pytest.mark.parametrize("name", mostly_slow(THIN, 2))
def test_thin_maps_keep_their_priors_and_say_why(tmp_path: Path, name: str) -> None:
    documents, reason = THIN[name]
    write_log(tmp_path / "log", documents)
    mapfold = Commands.in_folder(tmp_path)
    assert reason in mapfold("calibrate", "log").out
    for each in mapfold("calibrate", "log", "--json").json["constants"]:
        if each["count"] == 0:
            assert each["value"] == each["prior"]
            assert each["seen"] is None


def test_a_log_that_is_none_and_options_that_do_not_fit_are_errors(mapfold: Commands) -> None:
    assert "no log at nowhere" in mapfold("calibrate", "nowhere", code=2).err
    assert "are for --write" in mapfold("calibrate", "log", "--reason", "x", code=2).err
    assert (
        "no setting 'evidence.x'"
        in mapfold("calibrate", "log", "--set", "evidence.x=1", code=2).err
    )


@pytest.mark.slow
def test_a_second_calibration_gives_the_constants_of_the_first(mapfold: Commands) -> None:
    with LogReader(mapfold.folder / "log") as reader:
        first = calibrate(reader, Settings(fusion="evidence"))
        again = calibrate(reader, first.calibrated)
    assert first.calibrated != first.settings
    assert again.last == first.last
    assert again.calibrated == again.settings == first.calibrated


@pytest.mark.slow
def test_a_correction_counts(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=30)
    mapfold = Commands.in_folder(tmp_path)
    mapfold("edit", "log", "forget-run", "run-b", "--reason", "why")
    found = mapfold("calibrate", "log", "--json").json
    assert (found["keyframes"], found["runs"]) == (30, 1)


@pytest.mark.slow
def test_progress_counts_the_events_of_all_folds(mapfold: Commands) -> None:
    told: list[tuple[int, int]] = []
    with LogReader(mapfold.folder / "log") as reader:
        calibrate(reader, Settings(), progress=lambda done, total: told.append((done, total)))
    assert {total for _, total in told} == {6 * COUNT}
    assert [done for done, _ in told] == sorted(done for done, _ in told)
    assert told[-1] == (6 * COUNT, 6 * COUNT)


Start = Callable[..., Program]


@pytest.mark.slow
def test_a_recorder_that_takes_commands_records_it(
    mapfold: Commands, start: Start, endpoint: str
) -> None:
    log = mapfold.folder / "log"
    running = start("record", str(log), "--connect", endpoint, "--accept-edits")
    running.wait_for("taking commands")
    said = mapfold("calibrate", "log", "--write", "--json", "--connect", endpoint).json
    assert said["recorded"]["offset"] == 2 * COUNT
    running.end(signal.SIGINT)
    assert running.wait() == 0
    assert set(_settings(log).evidence.sizes_m) == set(SIZES)


@pytest.mark.slow
def test_a_log_that_another_writer_holds_is_named(tmp_path: Path) -> None:
    write_room(tmp_path / "log", count=20)
    mapfold = Commands.in_folder(tmp_path)
    away = ("--connect", "tcp/127.0.0.1:9")
    with LogWriter(mapfold.folder / "log"):
        said = mapfold("calibrate", "log", "--write", *away, code=1)
    assert "log is being written by process" in said.err
    assert _settings(mapfold.folder / "log") == Settings()
