"""Commands from what a person types: what they name in the log, and what is refused with what is
there or with the command that stands in the way."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    DropObject,
    ForgetKeyframes,
    ForgetRun,
    Join,
    KeepApart,
    NamePlace,
    SameObject,
    Undo,
    UndoMerge,
    UseSettings,
    encode_command,
    parse_command,
)
from eventsrc.envelope.trajectory import Trajectory, TrajectoryPose, read_trajectory
from projections.edit import make as by
from projections.edit.correct_poses import Span, by_trajectory, by_transform
from projections.edit.effect import what
from projections.fold.settings import Settings
from tests.support.logs import FAR, LEFT, MERGE, RIGHT, append, give, make, write_rooms

CUP_LEFT, CUP_RIGHT, LAMP = "obj-2237cc2f33929b56", "obj-dc4cb3fc37c4dc9a", "obj-36156c6b0fcc3c5d"
ALL = Span(None, None)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write_rooms(tmp_path / "log")


def _anchor(run: str, keyframe: int) -> Anchor:
    return Anchor(run_id=run, keyframe_id=keyframe)


IN_LEFT, IN_RIGHT, IN_FAR = _anchor("run-a", 0), _anchor("run-a", 7), _anchor("run-b", 0)
WHO: dict[str, Any] = {"command_id": "new", "issued_by": "me@here", "reason": "why"}


@pytest.mark.parametrize(
    ("function", "args", "command"),
    [
        (by.name_place, (LEFT, "hall"), NamePlace(place=IN_LEFT, name="hall", **WHO)),
        (by.name_place, (RIGHT, "bath 🛁"), NamePlace(place=IN_RIGHT, name="bath 🛁", **WHO)),
        (by.name_place, ("run-b:3", "x"), NamePlace(place=_anchor("run-b", 3), name="x", **WHO)),
        (by.keep_apart, (LEFT, RIGHT), KeepApart(places=(IN_LEFT, IN_RIGHT), **WHO)),
        (
            by.keep_apart,
            ("run-a:1", "run-a:9"),
            KeepApart(places=(_anchor("run-a", 1), _anchor("run-a", 9)), **WHO),
        ),
        (
            by.undo_merge,
            (MERGE,),
            UndoMerge(merge_offset=MERGE, places=(IN_LEFT, IN_RIGHT), **WHO),
        ),
        (by.join, (FAR, RIGHT), Join(places=(IN_FAR, IN_RIGHT), **WHO)),
        (by.same_object, (CUP_LEFT, "cup-3"), SameObject(det_ids=("cup-1", "cup-3"), **WHO)),
        (
            by.different_objects,
            ("cup-1", "cup-2"),
            DifferentObjects(det_ids=("cup-1", "cup-2"), **WHO),
        ),
        (
            by.different_objects,
            (CUP_LEFT, CUP_RIGHT),
            DifferentObjects(det_ids=("cup-1", "cup-3"), **WHO),
        ),
        (by.drop_object, (CUP_LEFT,), DropObject(det_ids=("cup-1", "cup-2"), **WHO)),
        (
            by.drop_detection,
            (["bare", "cup-1", "bare"],),
            DropDetection(det_ids=("bare", "cup-1"), **WHO),
        ),
        (by.forget_run, ("run-b",), ForgetRun(run_id="run-b", **WHO)),
        (
            by.forget_keyframes,
            ("run-a", "-5..3"),
            ForgetKeyframes(run_id="run-a", first=-5, last=3, **WHO),
        ),
    ],
)
def test_it_names_things_of_the_log(
    log: Path, function: Callable[..., Command], args: tuple[Any, ...], command: Command
) -> None:
    made = make(log, function, *args)
    assert made == command
    assert parse_command(encode_command(made)) == command


@pytest.mark.parametrize(
    ("function", "args", "says"),
    [
        (by.name_place, ("run-a_p9", "x"), f"under these settings; near it: {RIGHT}"),
        (by.name_place, ("", "x"), "no place ''"),
        (by.name_place, ("run-a:99", "x"), "no keyframe 'run-a:99' in this log; near it: run-a:24"),
        (by.name_place, ("run-a:x", "x"), "no keyframe 'run-a:x'"),
        (by.name_place, ("run-a:23", "x"), "run-a:23 is in no place, because it has no pose"),
        (by.name_place, ("run-a:24", "x"), "run-a:24 is in no place, because it is noise"),
        (by.name_place, (LEFT, ""), "name is empty"),
        (by.name_place, (LEFT, "a\x1b[2J"), "name has the control character U+001B at index 1"),
        (by.name_place, (LEFT, "x" * 257), "name is 257 characters long"),
        (by.name_place, (LEFT, "\ud800"), "name"),
        (by.keep_apart, (LEFT, LEFT), "are the same place; name two"),
        (by.keep_apart, ("run-a:0", LEFT), "are the same place"),
        (by.undo_merge, (MERGE - 1,), f"at offset 19; 1 event merged places, at {MERGE}"),
        (by.undo_merge, (-1,), "nothing merged at offset -1"),
        (by.undo_merge, (10**30,), "nothing merged at offset 1000"),
        (by.join, (LEFT, RIGHT), f"are one place already, {LEFT}"),
        (by.same_object, ("obj-1", CUP_LEFT), "no object 'obj-1' under these settings"),
        (by.same_object, ("cup-9", CUP_LEFT), "no observation 'cup-9' in this log; near it: cup-3"),
        (by.same_object, (CUP_LEFT, "bare"), "observation 'bare' is of no object"),
        (by.same_object, ("cup-1", "cup-2"), "are one object already"),
        (by.same_object, (CUP_LEFT, LAMP), "class 'cup', obj-36156c6b0fcc3c5d of 'lamp'"),
        (by.different_objects, (CUP_LEFT, "cup-1"), "are the same observation"),
        (by.drop_object, ("cup-1",), "no observation 'cup-1'"),
        (by.drop_detection, (["cup-1", "cup-7"],), "no observation 'cup-7'"),
        (by.drop_detection, (["\x1b"],), "no observation '\\x1b'"),
        (by.forget_run, ("run-c",), "no run 'run-c' in this log; near it: run-"),
        (by.forget_keyframes, ("run-c", "1..2"), "no run 'run-c'"),
        (by.forget_keyframes, ("run-a", "1-2"), "'1-2' is no range of keyframes; write it"),
        (by.forget_keyframes, ("run-a", "3..1"), "write it as 1..3"),
        (by.forget_keyframes, ("run-b", "9..12"), "in 9..12; it has 5 keyframes, 0 to 4"),
        (by.forget_keyframes, ("run-a", "0.." + "9" * 19), "last input should be less than"),
        (by.use_settings, (Settings(),), "these are the settings of the log already"),
        (by.undo, ("c1",), "no command 'c1' in this log; there is no command at all"),
        (by_transform, ("run-a", ALL, 0.0, 0.0, 0.0), "are all 0: nothing would move"),
        (by_transform, ("run-a", ALL, math.nan, 0.0, 0.0), "--dx nan"),
        (by_transform, ("run-a", ALL, 0.0, 1e9, 0.0), "--dy 1000000000.0"),
        (by_transform, ("run-a", Span(5, 1), 1.0, 0.0, 0.0), "--from 5 is more than --to 1"),
        (by_transform, ("run-b", Span(5, None), 1.0, 0.0, 0.0), "it has 5 keyframes, 0 to 4"),
        (by_transform, ("run-c", ALL, 1.0, 0.0, 0.0), "no run 'run-c'"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_refused_with_what_is(
    log: Path, function: Callable[..., Command], args: tuple[Any, ...], says: str
) -> None:
    with pytest.raises(MisuseError) as caught:
        make(log, function, *args)
    assert says.lower() in str(caught.value).lower()


Given = tuple[Callable[..., Command], tuple[Any, ...]]


@pytest.mark.parametrize(
    ("first", "then", "says"),
    [
        ((by.keep_apart, (FAR, LEFT)), (by.join, (LEFT, FAR)), "these places are kept apart by"),
        ((by.keep_apart, (FAR, RIGHT)), (by.join, (LEFT, FAR)), "these places are kept apart by"),
        ((by.join, (FAR, LEFT)), (by.keep_apart, (LEFT, FAR)), "these places are joined by"),
        ((by.keep_apart, (LEFT, FAR)), (by.keep_apart, (FAR, LEFT)), "are kept apart already"),
        ((by.undo_merge, (MERGE,)), (by.undo_merge, (MERGE,)), "at 20 is undone already, by"),
        ((by.undo_merge, (MERGE,)), (by.join, (LEFT, RIGHT)), "are kept apart by command first"),
        (
            (by.different_objects, (CUP_LEFT, CUP_RIGHT)),
            (by.same_object, (CUP_LEFT, CUP_RIGHT)),
            "these objects are kept apart by",
        ),
        (
            (by.different_objects, ("cup-2", "cup-3")),
            (by.same_object, ("cup-1", "cup-3")),
            "these objects are kept apart by",
        ),
        (
            (by.same_object, (CUP_LEFT, CUP_RIGHT)),
            (by.different_objects, ("cup-1", "cup-3")),
            "these objects are made one by",
        ),
        (
            (by.drop_detection, (["cup-1"],)),
            (by.drop_detection, (["cup-1"],)),
            "detection 'cup-1' is left out already, by",
        ),
        ((by.forget_run, ("run-b",)), (by.forget_run, ("run-b",)), "'run-b' is left out of"),
        (
            (by.forget_run, ("run-b",)),
            (by_transform, ("run-b", ALL, 1.0, 0.0, 0.0)),
            "'run-b' is left out of the map by",
        ),
        (
            (by.forget_keyframes, ("run-b", "3..4")),
            (by.forget_keyframes, ("run-b", "4..9")),
            "some are left out already by",
        ),
        (
            (by.name_place, (LEFT, "hall")),
            (by.name_place, ("run-a:9", "hall")),
            "is called 'hall' already",
        ),
        (
            (by.use_settings, (Settings(eps_m=1.0),)),
            (by.use_settings, (Settings(eps_m=1.0),)),
            "the settings of the log already",
        ),
    ],
)
def test_a_command_that_stands_in_the_way_is_named(
    log: Path, first: Given, then: Given, says: str
) -> None:
    given = give(log, first[0], *first[1], command_id="first")
    with pytest.raises(MisuseError) as caught:
        make(log, then[0], *then[1])
    message = str(caught.value)
    assert says in message
    if "already" not in says or " by" in says:
        assert f"command first ({given.kind} at offset 30, by me@here: why)" in message
    if says.endswith(("kept apart by", "joined by", "made one by")):
        assert f"`mapfold edit {log} undo first --reason WHY`" in message
        give(log, by.undo, "first", command_id="second")
        make(log, then[0], *then[1])


def test_a_command_that_a_chain_of_commands_contradicts_is_refused(log: Path) -> None:
    give(log, by.join, FAR, RIGHT, command_id="first")
    by_another_fold = Join(
        command_id="second", issued_by="me@here", places=(IN_FAR, _anchor("run-a", 3))
    )
    append(log, by_another_fold)
    with pytest.raises(MisuseError, match="joined by command first"):
        make(log, by.keep_apart, RIGHT, "run-a:3")
    give(log, by.undo, "second", command_id="third")
    give(log, by.keep_apart, RIGHT, "run-a:3", command_id="fourth")
    with pytest.raises(MisuseError, match="kept apart by command fourth"):
        make(log, by.join, FAR, "run-a:3")


def test_undo_names_a_command_that_is_not_undone_yet(log: Path) -> None:
    give(log, by.name_place, LEFT, "hall", command_id="first")
    assert make(log, by.undo, "first") == Undo(undone="first", **WHO)
    give(log, by.undo, "first", command_id="second")
    with pytest.raises(MisuseError, match="command first is undone already, by command second"):
        make(log, by.undo, "first")
    give(log, by.undo, "second", command_id="third")
    with pytest.raises(MisuseError, match="command second is undone already, by command third"):
        make(log, by.undo, "second")
    make(log, by.undo, "first")
    with pytest.raises(MisuseError, match=r"no command 'fist' in this log; near it: first"):
        make(log, by.undo, "fist")


def test_settings_are_recorded_in_full(log: Path) -> None:
    settings = Settings(eps_m=1.0, min_samples=8)
    made = make(log, by.use_settings, settings)
    assert isinstance(made, UseSettings)
    assert Settings.from_document(made.settings) == settings
    assert made.settings["fusion_similarity"] == 0.7, "whatever a later default is"


def test_settings_of_fusion_by_evidence_are_recorded_in_full_and_listed_by_name(log: Path) -> None:
    settings = Settings().with_assignments(["fusion=evidence", "evidence.sizes_m.cup=0.1"])
    made = make(log, by.use_settings, settings)
    assert isinstance(made, UseSettings)
    assert Settings.from_document(made.settings) == settings
    assert made.settings["evidence"]["range_m"] == 3.0, "whatever a later default is"
    assert made.settings["camera"]["hfov_deg"] is None, "nothing states it"
    assert what(made) == "fusion=evidence, evidence.sizes_m.cup=0.1"
    partial = UseSettings(**WHO, settings={"camera": {"hfov_deg": 90}})
    assert what(partial) == "camera.hfov_deg=90"
    assert what(UseSettings(**WHO, settings={})) == "the defaults"


def test_places_are_those_of_the_settings(log: Path) -> None:
    with pytest.raises(MisuseError, match="no place 'run-b_p0' under these settings"):
        make(log, by.name_place, FAR, "x", settings=Settings(min_samples=6))


def test_a_rigid_transform_has_its_cosine(log: Path) -> None:
    made = make(log, by_transform, "run-b", Span(1, None), 0.5, -1.0, math.pi / 3)
    assert isinstance(made, CorrectPoses)
    assert made.transform is not None
    assert (made.first, made.last) == (1, None)
    assert (made.transform.cos, made.transform.sin) == (
        math.cos(math.pi / 3),
        math.sin(math.pi / 3),
    )


def _file(tmp_path: Path, text: str) -> Trajectory:
    (tmp_path / "poses.csv").write_text(text)
    return read_trajectory(tmp_path / "poses.csv")


def test_a_file_of_other_keyframes_is_refused_by_line(log: Path, tmp_path: Path) -> None:
    poses = _file(tmp_path, "keyframe_id,x,y,yaw\n0,1,2,0\n77,1,2,0\n78,1,2,0\n")
    with pytest.raises(MisuseError) as caught:
        make(log, by_trajectory, "run-b", poses, ALL, 0.05)
    assert "line 3: run-b has no keyframe 77 (and 1 more such lines); it has 5" in str(caught.value)


def test_ignore_missing_takes_the_others_and_says_so(log: Path, tmp_path: Path) -> None:
    poses = _file(tmp_path, "keyframe_id,x,y,yaw\n0,1,2,0\n77,1,2,0\n3,4,5,6\n")
    notes: list[str] = []

    def command(current: Any, stamp: Any) -> Command:
        return by_trajectory(
            current, stamp, "run-b", poses, ALL, 0.05, ignore_missing=True, note=notes.append
        )

    made = make(log, command)
    assert isinstance(made, CorrectPoses)
    assert [(p.keyframe_id, p.x, p.y, p.yaw) for p in made.poses] == [(0, 1, 2, 0), (3, 4, 5, 6)]
    assert notes == [
        "3 keyframes left without correction, not in the file: run-b:1, run-b:2, run-b:4",
        "1 pose not used: run-b has no such keyframe",
    ]


def test_stamps_of_another_clock_are_refused_with_both(log: Path, tmp_path: Path) -> None:
    poses = _file(tmp_path, "stamp,x,y,yaw\n1,1,2,0\n9,1,2,0\n")
    with pytest.raises(MisuseError, match=r"its stamps, 1\.0 to 9\.0 s, are not .* 1774357200\.0"):
        make(log, by_trajectory, "run-b", poses, ALL, 0.05)


def test_keyframes_beyond_the_file_are_named(log: Path, tmp_path: Path) -> None:
    t = 1774357200
    poses = _file(tmp_path, f"stamp,x,y,yaw\n{t + 1},1,0,0\n{t + 3},3,0,0\n")
    notes: list[str] = []

    def command(current: Any, stamp: Any) -> Command:
        return by_trajectory(current, stamp, "run-b", poses, ALL, 0.05, note=notes.append)

    made = make(log, command)
    assert isinstance(made, CorrectPoses)
    assert [(p.keyframe_id, p.x) for p in made.poses] == [(1, 1.0), (2, 2.0), (3, 3.0)]
    assert "2 keyframes left without correction, more than --slack 0.05 s" in notes[0]
    assert notes[0].endswith("run-b:0, run-b:4")
    assert notes[1] == "poses interpolated over up to 2 s between two of the file"


def test_a_command_over_the_limit_is_refused_with_a_way_out(
    log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("projections.edit.correct_poses.MAX_COMMAND_BYTES", 300)
    poses = [TrajectoryPose(k, 0.1, 0.2, 0.3, k + 1) for k in range(5)]
    with pytest.raises(MisuseError, match=r"more than 300; give it in parts with --from and --to"):
        make(log, by_trajectory, "run-b", Trajectory("file", "keyframe", poses), ALL, 0.05)
    make(log, by_trajectory, "run-b", Trajectory("file", "keyframe", poses), Span(0, 1), 0.05)
