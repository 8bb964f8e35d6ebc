"""Map frames: a frame that no command joins is a map of its own; joined, it is part of the map."""

from collections.abc import Sequence
from typing import Any

import pytest

from eventsrc.envelope.commands import (
    Command,
    CorrectPoses,
    ForgetRun,
    JoinFrames,
    RigidTransform,
    Undo,
)
from eventsrc.envelope.model import KeyframeId, Offset, RunId
from projections.fold.corrections import RecordedCommand, compile_corrections
from projections.fold.deltas import FrameJoined, KeyframeAdded
from projections.fold.map_errors import ImpossibleCommand
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.frames import frames_line, frames_of, frames_text
from projections.map.state_output import state_document
from projections.map.view import MapView
from tests.support.envelopes import detection, envelope
from tests.support.folds import Folded, resumed, state_bytes

EVIDENCE = Settings(places="rooms", fusion="evidence")
CUP = [1.0, 0.0, 0.0]


def drive(run: str, frame: str | None, *, x: float = 0.0, y: float = 0.0) -> list[dict[str, Any]]:
    """Eight poses on a line of 3.5 m, with a cup in each picture, from a point of its frame on."""
    named = {} if frame is None else {"frame": frame}
    return [
        envelope(
            number,
            x + number / 2,
            y,
            run_id=run,
            detections=[detection("cup", CUP)],
            **named,
        )
        for number in range(8)
    ]


def joining(frame: str, into: str | None, dx: float, dy: float, number: int = 0) -> JoinFrames:
    move = RigidTransform.of(dx, dy, 0.0)
    return JoinFrames(
        command_id=f"j{number}", issued_by="ann", frame=frame, into=into, transform=move
    )


def fold(
    documents: Sequence[dict[str, Any]], *commands: Command, settings: Settings | None = None
) -> Folded:
    recorded = [RecordedCommand(Offset(1000 + n), each) for n, each in enumerate(commands)]
    return Folded.start(settings, compile_corrections(recorded)).extend(documents)


def map_of(view: MapView) -> dict[str, Any]:
    """Places, Objects and edges of a map."""
    document = state_document(view, None)
    return {name: document[name] for name in ("places", "objects", "adjacency")}


@pytest.mark.parametrize("settings", [Settings(), EVIDENCE], ids=["classic", "full"])
def test_a_frame_that_is_not_joined_is_a_map_of_its_own(settings: Settings) -> None:
    """At the same coordinates, with things that look the same: nothing becomes one."""
    both = fold(drive("r", "a") + drive("s", "b"), settings=settings)
    on_floor = [each | {"floor": "frame b"} for each in drive("s", "a")]
    assert map_of(both.view) == map_of(fold(drive("r", "a") + on_floor, settings=settings).view)
    parts = map_of(both.view)
    assert [each["place_id"] for each in parts["objects"]] == ["r_p0", "s_p0"]
    assert [each.get("floor") for each in parts["places"]] == [None, "frame b"]
    assert [(f.frame, f.joined, f.runs, f.keyframes) for f in frames_of(both.view)] == [
        ("b", None, ["s"], 8)
    ]
    assert frames_line(frames_of(both.view)) == "b (8 keyframes) held apart"
    assert not both.all(FrameJoined)


def test_one_frame_under_any_name_is_the_map_without_frames() -> None:
    """As are envelopes that name none."""
    plain = fold(drive("r", None) + drive("s", None, y=1.0)).view
    for named in (
        drive("r", "odom") + drive("s", "odom", y=1.0),
        drive("r", "odom") + drive("s", None, y=1.0),
    ):
        found = fold(named).view
        assert map_digest(found) == map_digest(plain)
        assert frames_of(found) == []


@pytest.mark.parametrize("settings", [Settings(), EVIDENCE], ids=["classic", "full"])
def test_a_joined_frame_is_part_of_the_map(settings: Settings) -> None:
    """All of its runs, also one that comes later, as if their poses were in the map's frame."""
    here = drive("r", None) + drive("s", None, y=1.0) + drive("t", None, x=4.0)
    there = drive("r", "a") + drive("s", "b", x=-8.0, y=-3.0) + drive("t", "b", x=-4.0, y=-4.0)
    joined = fold(there, joining("b", "a", 8.0, 4.0), settings=settings)
    assert map_of(joined.view) == map_of(fold(here, settings=settings).view)
    (delta,) = joined.all(FrameJoined)
    assert (delta.frame, delta.into, delta.offset, delta.command) == ("b", "a", 8, 1000)
    assert [type(each) for each in joined.deltas[8][1:3]] == [FrameJoined, KeyframeAdded]
    (frame,) = frames_of(joined.view)
    assert (frame.runs, frame.keyframes, frame.state) == (["s", "t"], 16, "joined to a")
    assert frame.document()["into"] == "a"
    assert "joined to a" in frames_text([frame])
    unnamed = fold(drive("r", None) + there[8:], joining("b", None, 8.0, 4.0), settings=settings)
    assert map_of(unnamed.view) == map_of(joined.view)
    undone = Undo(command_id="u", issued_by="ann", undone="j0")
    apart = fold(there, joining("b", "a", 8.0, 4.0), undone, settings=settings)
    assert map_digest(apart.view) == map_digest(fold(there, settings=settings).view)


def test_joins_follow_each_other_and_the_corrections_of_a_run() -> None:
    here = drive("r", "a") + drive("s", "a", y=1.0) + drive("t", "a", y=2.0)
    there = drive("r", "a") + drive("s", "b", y=5.0) + drive("t", "c", y=9.0)
    own = CorrectPoses(
        command_id="own",
        issued_by="ann",
        run_id=RunId("t"),
        transform=RigidTransform.of(0.0, 1.0, 0.0),
    )
    commands = joining("c", "b", 0.0, -4.0), joining("b", "a", 0.0, -4.0, 1), own
    found = fold(there, *commands)
    assert map_of(found.view) == map_of(fold(here).view)
    assert [delta.frame for delta in found.all(FrameJoined)] == ["b", "c"]
    assert compile_corrections([]).frame_joins("b") == []


def test_of_joins_that_close_a_circle_the_last_ones_count() -> None:
    commands = [
        joining("a", "b", 1.0, 0.0),
        joining("b", "c", 1.0, 0.0, 1),
        joining("c", "a", 1.0, 0.0, 2),
        joining("b", "c", 2.0, 0.0, 3),
    ]
    compiled = compile_corrections(
        [RecordedCommand(Offset(n), each) for n, each in enumerate(commands)]
    )
    assert [(j.frame, j.into, j.offset) for j in compiled.frame_joins("b")] == [
        ("b", "c", 3),
        ("c", "a", 2),
    ]
    assert compiled.frame_joins("a") == []
    assert compiled.fingerprint() != compile_corrections([]).fingerprint() == ""


def test_a_fold_that_was_kept_goes_on_with_its_frames() -> None:
    documents = drive("r", "a") + drive("s", "b") + drive("t", "c", y=1.0)
    move = joining("c", "a", 0.0, 0.5)
    whole = fold(documents, move)
    for at in (4, 12, 20):
        again = resumed(fold(documents[:at], move)).extend(documents[at:])
        assert map_digest(again.view) == map_digest(whole.view)
        assert state_bytes(again) == state_bytes(whole)


def test_nothing_else_becomes_the_frame_that_one_was_joined_to() -> None:
    """Where the first run is left out, later ones in its frame are in the map still, and others are
    held apart still."""
    documents = drive("r", "a") + drive("s", "b") + drive("c", "c") + drive("t", "a")
    forget = ForgetRun(command_id="f", issued_by="ann", run_id=RunId("r"))
    found = fold(documents, joining("b", "a", 0.0, 0.0), forget)
    assert [each["place_id"] for each in map_of(found.view)["places"]] == ["s_p0", "c_p0"]
    assert [(each.frame, each.joined is None) for each in frames_of(found.view)] == [
        ("b", False),
        ("c", True),
    ]
    unnamed = drive("r", None) + drive("c", "c") + drive("s", "b") + drive("t", None)
    for runs in (unnamed, unnamed[16:] + unnamed[8:16]):
        found = fold(runs, joining("b", None, 0.0, 0.0))
        assert [each.frame for each in frames_of(found.view) if each.joined is None] == ["c"]


def test_a_join_that_moves_a_pose_out_of_the_map_is_named() -> None:
    far = drive("r", "a") + drive("s", "b", x=9e6)
    with pytest.raises(ImpossibleCommand, match="join-frames j0 at offset 1000 moves keyframe 0"):
        fold(far, joining("b", "a", 9e6, 0.0))


def test_a_keyframe_in_another_frame_is_no_duplicate() -> None:
    first, second = drive("r", "a")[:1], drive("r", "b")[:1]
    assert fold(first + second).view.skipped["conflict"] == 1
    assert KeyframeId(0) == fold(first + second).view.keyframes[0].keyframe_id


def test_a_frame_joined_to_itself_is_refused() -> None:
    with pytest.raises(ValueError, match="frame and into must be two frames"):
        joining("b", "b", 1.0, 0.0)
