"""`mapfold align`: two runs of one log, or of two logs, in frames of their own."""

import json
from pathlib import Path

import numpy as np
import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import CorrectPoses, JoinFrames, RigidTransform
from eventsrc.envelope.model import KeyframeId
from eventsrc.log import LogReader
from projections.edit.correct_poses import Span, by_alignment
from projections.edit.current import MapToEdit
from projections.edit.make import Stamp
from projections.fold.settings import Settings
from projections.localize.align.framed_things import own_map
from projections.localize.align.matching import moved
from projections.map.parsing import read_corrections
from tests.property.test_align import HERE, in_frame, jumped
from tests.support.commands import Commands
from tests.support.logs import append_command, join_frames, simulated, walk, write_log
from tests.support.thorough import stride

FRAME = (12.0, -7.0, 2.1)
WHOLE = Span(None, None)
CAMERA = {"hfov_deg": 69.4, "width_px": 640, "height_px": 400}


def lines(run: str, frame: tuple[float, float, float], seed: int = 7) -> str:
    seen = simulated(seed, run).envelopes[:: stride(2)]
    documents = (in_frame(each, frame) for each in seen)
    return "".join(json.dumps(each | {"camera": CAMERA}) + "\n" for each in documents)


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def log_of(mapfold: Commands, name: str, *parts: str) -> Path:
    (mapfold.folder / f"{name}.jsonl").write_text("".join(parts))
    mapfold("import", name, f"{name}.jsonl", "--preset", "full")
    return mapfold.folder / name


def test_a_run_is_brought_into_the_frame_of_the_first(mapfold: Commands) -> None:
    log = log_of(mapfold, "log", lines("a", HERE), lines("b", FRAME))
    apart = mapfold("state", log, "--json").json["counts"]
    said = mapfold("align", log, "--picture", "both.png")
    assert said.out.startswith("sim-7-b into the frame of sim-7-a: moved by (")
    assert "nothing is recorded; --write records" in said.err
    assert "both maps are in both.png" in said.err
    assert (mapfold.folder / "both.png").read_bytes().startswith(b"\x89PNG")
    told = mapfold("align", log, "--run", "sim-7-b", "--to", "sim-7-a", "--write", "--json").json
    assert (told["verdict"], told["runs"], told["to"]) == ("sure", ["sim-7-b"], "sim-7-a")
    assert len(told["pairs"]) == told["common"] >= 12
    (command,) = told["recorded"]
    edits = mapfold("edits", log).out
    assert f"aligned to sim-7-a: {told['common']} common things" in edits
    assert command["command_id"] in edits
    joined = mapfold("state", log, "--json").json["counts"]
    assert joined["places"] < apart["places"]
    assert joined["objects"] < apart["objects"]
    again = mapfold("align", log, "--write")
    assert "already in one frame" in again.out
    assert mapfold("edits", log).out.count("correct-poses") == 1


@pytest.mark.slow
def test_a_log_is_brought_into_the_frame_of_another(mapfold: Commands) -> None:
    frame = log_of(mapfold, "frame", lines("a", HERE))
    log = log_of(mapfold, "log", lines("b", FRAME))
    mapfold("align", log, "--to", frame, "--write")
    assert "already in one frame" in mapfold("align", log, "--to", frame).out


@pytest.mark.slow
def test_a_log_is_compared_by_what_is_in_the_frame_of_its_map(mapfold: Commands) -> None:
    """A run that it holds apart would be a second place that looks alike."""
    apart = lines("b", (3.0, -4.0, 1.0)).replace('"run_id"', '"frame": "b", "run_id"')
    frame = log_of(mapfold, "frame", lines("a", HERE), apart)
    log = log_of(mapfold, "log", lines("b", FRAME))
    assert "moved by (" in mapfold("align", log, "--to", frame).out


@pytest.mark.slow
def test_what_is_not_sure_is_not_written_without_a_yes(mapfold: Commands) -> None:
    """Two houses whose furniture happens to agree in part; and one with a part of a drive."""
    log = log_of(mapfold, "log", lines("a", HERE), lines("a", HERE, seed=3))
    said = mapfold("align", log, "--write", code=3)
    assert "sim-3-a into the frame of sim-7-a: moved by (" in said.out
    assert "but not surely" in said.out
    assert "nothing is recorded; --write --yes records" in said.err
    assert "correct-poses" not in mapfold("edits", log).out
    mapfold("align", log, "--write", "--yes")
    assert mapfold("edits", log).out.count("correct-poses") == 1
    few = "".join(lines("b", FRAME).splitlines(keepends=True)[: 14 // stride(2)])
    part = log_of(mapfold, "part", lines("a", HERE), few)
    said = mapfold("align", part, "--write", "--yes", code=3)
    assert "sim-7-b into the frame of sim-7-a: cannot tell: " in said.out


@pytest.mark.slow
def test_all_runs_are_brought_into_the_frame_of_the_first(mapfold: Commands) -> None:
    third = lines("b", (-3.0, 9.0, -0.8)).replace("sim-7-b", "third")
    other = lines("a", HERE, seed=3)[: len(lines("a", HERE, seed=3)) // 9]
    few = other[: other.rindex("\n") + 1]
    log = log_of(mapfold, "log", lines("a", HERE), lines("b", FRAME), third, few)
    said = mapfold("align", log, code=3)
    assert "sim-7-b into the frame of sim-7-a: moved by (" in said.out
    assert "third into the frame of sim-7-a: moved by (" in said.out
    assert "sim-3-a: cannot tell: too little in common with every other run" in said.out
    told = mapfold("align", log, "--write", "--json", code=3).json
    assert [each["verdict"] for each in told["runs"]] == ["sure", "sure", "unknown"]
    assert (told["contradictions"], len(told["recorded"])) == ([], 2)
    again = mapfold("align", log, code=3).out
    assert again.count("already in one frame") == 2


@pytest.mark.slow
def test_the_tail_behind_a_jump_is_brought_back(mapfold: Commands) -> None:
    """By what both parts of the run and another run, in a frame of its own, have seen."""
    bad = "".join(json.dumps(each | {"camera": CAMERA}) + "\n" for each in jumped("a", 200))
    log = log_of(mapfold, "log", bad, lines("b", FRAME))
    said = mapfold("align", log, "--jumps", code=3)
    assert said.out.startswith("sim-7-a: a step of ")
    assert "from there to the end moved by (" in said.out
    assert "nothing is recorded; --write records" in said.err
    told = mapfold("align", log, "--jumps", "--run", "sim-7-a", "--write", "--json").json
    (step,) = told["steps"]
    assert (step["jumped"], step["run"], step["last"]) == (True, "sim-7-a", None)
    assert "its frame jumped: " in mapfold("edits", log).out
    assert "no frame jumped" in mapfold("align", log, "--jumps").out
    said = mapfold("align", log, "--jumps", "--to", "sim-7-a", code=2)
    assert "--jumps takes neither --to nor --picture" in said.err


def poses_of_b(mapfold: Commands, log: Path) -> np.ndarray:
    seen = mapfold("state", log, "--json").json["keyframes"]
    run = [k for k in seen if k["run_id"] == "run-b" and k["map_x"] is not None]
    return np.array([(k["map_x"], k["map_y"]) for k in run])


def test_frames_are_listed_and_joined_by_a_command(mapfold: Commands) -> None:
    here = walk(12) + [each | {"frame": "b"} for each in walk(12, run_id="run-b")]
    log = write_log(mapfold.folder / "log", here)
    assert mapfold("merges", log, "--frames", "--at", "12").out == (
        "all keyframes are in one frame\n"
    )
    (apart,) = mapfold("merges", log, "--frames", "--json").json
    assert (apart["frame"], apart["held_apart"], apart["runs"]) == ("b", True, ["run-b"])
    state = mapfold("state", log, "--json").json
    assert state["frames"] == [apart]
    assert state["floors"] == ["frame b"]
    assert f"b ({apart['keyframes']} keyframes) held apart" in mapfold("state", log).out
    said = mapfold("edit", log, "join-frames", "c", "--reason", "x", code=2)
    assert "frame c: no keyframe names it, or the map's own; held apart are b" in said.err
    joining = ["edit", log, "join-frames", "b", "--dx", "0.5", "--reason", "one house"]
    mapfold(*joining, "--command-id", "c1")
    assert "join-frames b into the map's own: dx=0.5 dy=0 dyaw=0" in mapfold("edits", log).out
    (joined,) = mapfold("merges", log, "--frames", "--json").json
    assert joined == apart | {"held_apart": False, "into": None, "command": 24} | {
        "dx": 0.5, "dy": 0.0, "dyaw_rad": 0.0, "offset": joined["offset"]
    }  # fmt: skip
    assert "joined to the map" in mapfold("merges", log, "--frames").out
    assert "frames" not in mapfold("state", log, "--at", "12", "--json").json
    assert mapfold("state", log, "--at", "24", "--json").json["frames"] == [apart]
    assert mapfold("state", log, "--at", "24", "--known-at", "end", "--json").json["frames"] == [
        joined
    ]
    assert "frame b: joined already" in mapfold(*joining, code=2).err
    before = poses_of_b(mapfold, log)
    mapfold("edit", log, "undo", "c1", "--reason", "x")
    mapfold(*joining[:-2], "--dy", "-3", "--dyaw", "2.0", "--reason", "y")
    placed = poses_of_b(mapfold, log)
    move = ["--dx", "1", "--dy", "2", "--dyaw", "0.3"]
    mapfold("edit", log, "correct-poses", "run-b", *move, "--reason", "z")
    assert np.abs(moved(placed, (1.0, 2.0, 0.3)) - poses_of_b(mapfold, log)).max() < 1e-5
    assert np.abs(before - placed).max() > 0.5
    (mapfold.folder / "poses.csv").write_text("keyframe_id,x,y,yaw\n0,1,2,0\n")
    said = mapfold("edit", log, "correct-poses", "run-b", "poses.csv", "--reason", "z")
    assert "poses.csv: read as poses in frame b, which join-frames moves then" in said.err
    said = mapfold("merges", log, "--frames", "--objects", code=2)
    assert "are tables of their own; give one alone" in said.err


def test_a_run_is_moved_with_the_frame_that_it_is_in_after_all_joins(mapfold: Commands) -> None:
    """And never into one held apart alone, nor by one of several frames."""
    runs = {"run-a": "a", "run-b": "b", "run-c": "c", "run-d": "d"}
    here = [each | {"frame": f} for run, f in runs.items() for each in walk(6, run_id=run)]
    log = write_log(mapfold.folder / "log", here + walk(6, run_id="run-d", first=6))
    mapfold("edit", log, "join-frames", "c", "--into", "b", "--dx", "1", "--reason", "x")
    with LogReader(log) as reader:
        current = MapToEdit(reader, lambda _: Settings())

        def moved_run(run: str, to: str | None, span: Span = WHOLE) -> CorrectPoses | JoinFrames:
            by = by_alignment(current, Stamp("id", "ann", ""), run, to, span, 1, 2, 0.3)
            assert by.transform == RigidTransform.of(1, 2, 0.3)
            return by

        to_map, same = moved_run("run-c", "run-a"), moved_run("run-b", "run-c")
        assert isinstance(to_map, JoinFrames)
        assert (to_map.frame, to_map.into) == ("b", "a")
        assert isinstance(same, CorrectPoses)
        assert isinstance(moved_run("run-b", "another log"), CorrectPoses)
        with pytest.raises(MisuseError, match="the other way round, --run run-c --to run-a"):
            moved_run("run-a", "run-c")
        with pytest.raises(MisuseError, match="run-d has keyframes in several frames, d, the map"):
            moved_run("run-d", "run-c")
        jumped = moved_run("run-d", None, Span(None, KeyframeId(5)))  # a frame, not a jump in one
        assert isinstance(jumped, JoinFrames)
        assert (jumped.frame, jumped.into) == ("d", "a")
        assert isinstance(moved_run("run-d", None, Span(KeyframeId(6), None)), CorrectPoses)
        assert isinstance(moved_run("run-b", None, Span(None, KeyframeId(3))), CorrectPoses)
    mapfold("edit", log, "join-frames", "d", "--into", "a", "--reason", "x")
    assert "join-frames d into a: dx=0 dy=0 dyaw=0" in mapfold("edits", log).out
    said = mapfold("edit", log, "join-frames", "a", "--reason", "x", code=2)
    assert "frame a: no keyframe names it, or the map's own; held apart are b" in said.err


def test_a_run_in_two_frames_is_compared_by_its_keyframes_in_that_of_the_map(
    tmp_path: Path,
) -> None:
    """Nor by those in a frame that is joined to one held apart."""
    seen = [each for each in walk(14, run_id="run-a") if "map_x" in each]
    log = write_log(
        tmp_path / "log", [each | {"frame": "abc"[k % 3]} for k, each in enumerate(seen)]
    )
    append_command(log, join_frames("c", "b"))
    with LogReader(log) as reader:
        known = read_corrections(reader)
        view = own_map(reader, reader.next_offset, known, Settings())
    expected = [each["keyframe_id"] for each in seen[::3]]
    assert [each.keyframe_id for each in view.keyframes] == expected


@pytest.mark.slow
def test_frames_of_two_names_that_are_one_are_joined(mapfold: Commands) -> None:
    """As of robots that are localised in one map and put their names before that of its frame."""
    away = lines("b", HERE).replace('"run_id"', '"frame": "b", "run_id"')
    log = log_of(mapfold, "log", lines("a", HERE), away)
    said = mapfold("align", log, "--write")
    assert "already in one frame, within " in said.out
    assert ", under two names, which --write joins" in said.out
    (frame,) = mapfold("merges", log, "--frames", "--json").json
    assert not frame["held_apart"]
    assert "under two names" not in mapfold("align", log).out


@pytest.mark.slow
def test_a_frame_that_is_held_apart_is_joined_with_all_its_runs(mapfold: Commands) -> None:
    third = lines("b", FRAME).replace("sim-7-b", "third")
    away = (lines("b", FRAME) + third).replace('"run_id"', '"frame": "b", "run_id"')
    log = log_of(mapfold, "log", lines("a", HERE), away)
    assert mapfold("merges", log, "--frames", "--json").json[0]["runs"] == ["sim-7-b", "third"]
    said = mapfold("align", log, "--write")
    assert "third: moved with its frame, which is joined already" in said.err
    assert mapfold("edits", log).out.count("join-frames b into the map's own") == 1
    assert mapfold("align", log).out.count("already in one frame") == 2


def test_a_log_without_runs_says_so(mapfold: Commands) -> None:
    said = mapfold("align", log_of(mapfold, "empty"), "--run", "x", code=2)
    assert "has no run that could be aligned" in said.err


@pytest.mark.slow
def test_runs_that_are_not_there_are_named_with_those_that_are(mapfold: Commands) -> None:
    log = log_of(mapfold, "log", lines("a", HERE), lines("b", HERE))
    runs = "the runs are sim-7-a, sim-7-b"
    said = mapfold("align", log, "--run", "x", code=2)
    assert f"--run x: not in {log}; {runs}" in said.err
    said = mapfold("align", log, "--to", "x", code=2)
    assert f"--to x: neither a run of {log} nor a log; {runs}" in said.err
    said = mapfold("align", log, "--run", "sim-7-a", "--to", "sim-7-a", code=2)
    assert "--run and --to are both sim-7-a" in said.err
    said = mapfold("align", log, "--picture", "both.jpg", code=2)
    assert "a picture is .png, .svg or .pdf" in said.err


@pytest.mark.slow
def test_a_log_of_one_run_has_none_to_move(mapfold: Commands) -> None:
    log = log_of(mapfold, "log", lines("a", HERE))
    said = mapfold("align", log, code=2)
    assert (
        "has one run, sim-7-a: import another one into it, or name another log by --to" in said.err
    )


@pytest.mark.slow
def test_a_map_without_embeddings_has_nothing_to_compare(mapfold: Commands) -> None:
    bare = []
    for line in (lines("a", HERE) + lines("b", FRAME)).splitlines():
        envelope = json.loads(line)
        for seen in envelope["detections"]:
            for field in ("embedding", "embedding_dim", "embedding_model"):
                del seen[field]
        bare.append(json.dumps(envelope) + "\n")
    said = mapfold("align", log_of(mapfold, "log", *bare), code=1)
    assert "sim-7-a: no object has both an embedding and a position" in said.err
