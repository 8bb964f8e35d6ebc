"""Logs with commands in them: walks in which commands of every kind are recorded at any point."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from eventsrc.envelope.commands import (
    Anchor,
    Command,
    CorrectedPose,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    DropObject,
    ForgetKeyframes,
    ForgetRun,
    Join,
    KeepApart,
    NamePlace,
    RigidTransform,
    SameObject,
    Undo,
    UndoMerge,
    UseSettings,
    encode_command,
)
from eventsrc.envelope.model import DetId, KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogWriter, parse_fsync
from eventsrc.record.append import append_payload
from tests.support.envelopes import payload
from tests.support.fixtures_timetravel import walks

STAMP_NS = 1_774_400_000_000_000_000


def anchor(run_id: str, keyframe_id: int) -> Anchor:
    """A keyframe that stands for its place."""
    return Anchor(run_id=RunId(run_id), keyframe_id=KeyframeId(keyframe_id))


def write_mixed_log(path: Path, items: Iterable[dict[str, Any] | Command]) -> Path:
    """A log of these envelopes and commands, in this order."""
    with LogWriter(path, fsync=parse_fsync("never")) as writer:
        for item in items:
            if isinstance(item, dict):
                append_payload(writer, "tb/detections", payload(item))
            else:
                writer.append(COMMAND_KEY, encode_command(item), stamp_ns=STAMP_NS)
    return path


PLACES = ("name", "apart", "join", "undo-merge")
OBJECTS = ("same", "same", "different", "drop", "drop-object")
EVENTS = ("forget", "forget-run", "poses", "transform", "settings")


@st.composite
def commands(
    draw: st.DrawFn,
    kinds: Sequence[str],
    keyframes: Sequence[tuple[str, int]],
    det_ids: Sequence[str],
    number: int,
) -> Command:
    """A command on some keyframes and detections; of an undo the one undone is any earlier."""
    said = {"command_id": f"c{number}", "issued_by": "ann@lab", "reason": "seen with own eyes"}
    runs, anchors = [run for run, _ in keyframes], st.sampled_from(keyframes)

    def one() -> Anchor:
        return anchor(*draw(anchors))

    def pair() -> tuple[DetId, DetId]:
        return DetId(draw(st.sampled_from(det_ids))), DetId(draw(st.sampled_from(det_ids)))

    possible = [kind for kind in kinds if det_ids or kind not in OBJECTS] or [*PLACES]
    match draw(st.sampled_from([*possible, *(["undo"] if number else [])])):
        case "name":
            return NamePlace(place=one(), name=draw(st.sampled_from(["kitchen", "hall"])), **said)
        case "apart":
            return KeepApart(places=(one(), one()), **said)
        case "join":
            return Join(places=(one(), one()), **said)
        case "undo-merge":
            return UndoMerge(merge_offset=Offset(0), places=(one(), one(), one()), **said)
        case "forget":
            run, first = draw(anchors)
            last = KeyframeId(first + draw(st.integers(0, 9)))
            return ForgetKeyframes(run_id=run, first=KeyframeId(first), last=last, **said)
        case "forget-run":
            return ForgetRun(run_id=RunId(draw(st.sampled_from(runs))), **said)
        case "poses":
            run, keyframe = draw(anchors)
            x = draw(st.sampled_from([0.0, 1.4, 3.5]))
            pose = CorrectedPose(keyframe_id=KeyframeId(keyframe), x=x, y=0.0, yaw=0.0)
            return CorrectPoses(run_id=RunId(run), poses=(pose,), **said)
        case "transform":
            run, _ = draw(anchors)
            moved = RigidTransform.of(draw(st.sampled_from([0.7, -2.1])), 0.0, 0.5)
            return CorrectPoses(run_id=RunId(run), transform=moved, **said)
        case "settings":
            chosen = draw(st.sampled_from([{"eps_m": 1.1}, {"min_samples": 2}]))
            return UseSettings(settings=dict(chosen), **said)
        case "same":
            return SameObject(det_ids=pair(), **said)
        case "different":
            return DifferentObjects(det_ids=pair(), **said)
        case "drop":
            return DropDetection(det_ids=(pair()[0],), **said)
        case "drop-object":
            return DropObject(det_ids=pair(), **said)
        case _:
            return Undo(undone=f"c{draw(st.integers(0, number - 1))}", **said)


@st.composite
def corrected_walks(draw: st.DrawFn, most: int = 40) -> list[dict[str, Any] | Command]:
    """A walk with up to eight commands somewhere in it, also before what they name: of some kinds
    or of all."""
    items: list[dict[str, Any] | Command] = list(draw(walks(most)))
    named = [d for d in items if isinstance(d, dict) and "run_id" in d]
    keyframes = sorted({(d["run_id"], d["keyframe_id"]) for d in named})
    det_ids = sorted({seen["det_id"] for d in named for seen in d["detections"]})
    if not keyframes:
        return items
    kinds = draw(st.sampled_from([PLACES, PLACES, OBJECTS, (*PLACES, *OBJECTS, *EVENTS)]))
    count = draw(st.integers(1, 8))
    points = sorted(draw(st.integers(0, len(items))) for _ in range(count))
    for number, point in enumerate(points):
        items.insert(point + number, draw(commands(kinds, keyframes, det_ids, number)))
    return items
