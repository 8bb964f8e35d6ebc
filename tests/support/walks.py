"""Logs for the time travel tests: walks through a small building, written as real logs.

Logs with commands in them: walks in which commands of every kind are recorded at any point.
"""

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
    Relabel,
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
from tests.support.envelopes import detection, envelope, payload

VECTORS = {"cup": [1.0, 0.0, 0.1, 0.0], "chair": [0.0, 1.0, 0.0, 0.1], "lamp": [0.3, 0.0, 1.0, 0.0]}


NOT_AN_ENVELOPE = {"nothing": "a robot would send"}
"""An invalid payload: it is logged as rejected and changes nothing."""


def write_log(path: Path, documents: Iterable[dict[str, Any]]) -> Path:
    """A log of these envelopes, in this order."""
    with LogWriter(path, fsync=parse_fsync("never")) as writer:
        for document in documents:
            append_payload(writer, "tb/detections", payload(document))
    return path


def write_damaged_log(path: Path, documents: Iterable[dict[str, Any]]) -> Path:
    """The same, and at its end an event under a robot's key that cannot be folded."""
    write_log(path, documents)
    with LogWriter(path) as writer:
        writer.append("tb/detections", b"not an envelope", stamp_ns=0)
    return path


@st.composite
def walks(draw: st.DrawFn, most: int = 40) -> list[dict[str, Any]]:
    """Envelopes of two runs that jump about in a corridor, so that places form apart and merge;
    with keyframes out of order, repeated, without a pose, refused, and look-alike objects."""
    count = draw(st.sampled_from([0, 1, most // 4, most // 2, most, most]))
    steps = draw(st.permutations([(n % 10, n % 13 // 12) for n in range(count)]))
    documents: list[dict[str, Any]] = []
    for number, (x, y) in enumerate(steps):
        if draw(st.integers(0, 19)) == 0:
            documents.append(NOT_AN_ENVELOPE)
            continue
        run = draw(st.sampled_from(["run-a", "run-a", "run-b"]))
        late = draw(st.integers(0, 9)) == 0
        keyframe = max(0, number - draw(st.integers(1, 3))) if late else 2 * number
        seen = [
            detection(name, VECTORS[name], det_id=f"{run}-{keyframe}-{number}-{i}")
            for i, name in enumerate(draw(st.lists(st.sampled_from(list(VECTORS)), max_size=2)))
        ]
        posed = draw(st.integers(0, 9)) > 0
        documents.append(
            envelope(
                keyframe,
                0.7 * x if posed else None,
                1.1 * y,
                run_id=run,
                detections=seen,
            )
        )
    return documents


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
OBJECTS = ("same", "same", "different", "drop", "drop-object", "relabel")
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
        case "relabel":
            label, name = (draw(st.sampled_from(sorted(VECTORS))) for _ in range(2))
            return Relabel(labels=((label, name),), **said)
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
