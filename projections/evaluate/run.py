"""The whole evaluation: fold the map's log, ask from the query logs, score everything.

Trials to numbers.

Accuracy and errors are over *known* questions (some true instance of theirs is in the map), errors
over those that have a pose. ``auroc`` is that of confidence between known and unknown questions.
Calibration counts all questions: an answer is right when the question is known and the pose is
within 1.5 m of the truth.

The scores as a table for people.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eventsrc.log import LogReader
from eventsrc.log.seek import Note, resolve
from projections.model.fold import fold_log
from projections.model.view import MapView
from projections.relocalize import DEFAULT_CAMERA, Camera, Method
from projections.settings import Settings

from .questions import DEFAULT_SEED, check_truth, make_questions, read_keyframes
from .scores import (
    auroc,
    expected_calibration_error,
    object_scores,
    percentile,
    place_scores,
    reliability,
)
from .trials import Examiner, FloorPlan, Trial
from .truth import Truth

RIGHT_WITHIN_M = 1.5


def right(trial: Trial) -> bool:
    """Whether the pose hypothesis is good enough to act on."""
    return trial.known and trial.pose_error_m is not None and trial.pose_error_m <= RIGHT_WITHIN_M


def summarise(trials: Sequence[Trial]) -> dict[str, Any]:
    """Everything about re-localisation with one number of crops."""
    known = [t for t in trials if t.known]
    unknown = [t for t in trials if not t.known]
    roomed = [t for t in known if t.question.room is not None]
    confidence = [t.answer.confidence for t in trials]
    correct = [right(t) for t in trials]
    return {
        "questions": len(trials),
        "known": len(known),
        "top1_room": _share(roomed, lambda t: t.question.room in t.rooms_of_places[:1]),
        "top3_room": _share(roomed, lambda t: t.question.room in t.rooms_of_places[:3]),
        "top1_contains_room": _share(roomed, lambda t: any(t.contains[:1])),
        "top3_contains_room": _share(roomed, lambda t: any(t.contains[:3])),
        "pose_room": _share(roomed, lambda t: t.question.room == t.room_of_pose),
        "room_at_pose": _share(roomed, lambda t: t.question.room == t.room_at_pose),
        "room_ceiling": _share(roomed, lambda t: t.room_has_place),
        "nearest_place": _share(
            [t for t in known if t.nearest_place is not None], lambda t: bool(t.nearest_place)
        ),
        "pose_error_m": _percentiles([t.pose_error_m for t in known]),
        "yaw_error_rad": _percentiles([t.yaw_error_rad for t in known]),
        "centroid_error_m": _percentiles([t.centroid_error_m for t in known]),
        "within_1_5_m": _share(known, right),
        "known_called_unknown": _share(known, lambda t: t.answer.unknown),
        "unknown_called_unknown": _share(unknown, lambda t: t.answer.unknown),
        "auroc": auroc(
            [t.answer.confidence for t in known], [t.answer.confidence for t in unknown]
        ),
        "ece": expected_calibration_error(confidence, correct),
        "reliability": reliability(confidence, correct),
        "latency_ms": _latency(trials),
    }


def _share(trials: Sequence[Trial], holds: Callable[[Trial], bool]) -> float | None:
    return sum(holds(t) for t in trials) / len(trials) if trials else None


def _percentiles(values: Sequence[float | None]) -> dict[str, float | None]:
    present = [value for value in values if value is not None]
    return {"p50": percentile(present, 0.5), "p90": percentile(present, 0.9)}


def _latency(trials: Sequence[Trial]) -> dict[str, float | None]:
    milliseconds = [t.seconds * 1000.0 for t in trials]
    return {"p50": percentile(milliseconds, 0.5), "p99": percentile(milliseconds, 0.99)}


CROPS = (1, 2, 3)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Scores in the shape of ``evaluate --json``, and what the picture is drawn from."""

    scores: dict[str, Any]
    trials: dict[int, list[Trial]]
    view: MapView


def evaluate(
    map_log: Path,
    query_logs: Sequence[Path],
    truth: Truth,
    settings: Settings,
    *,
    until: str = "end",
    method: Method = "joint",
    camera: Camera = DEFAULT_CAMERA,
    seed: int = DEFAULT_SEED,
    note: Note | None = None,
) -> Evaluation:
    """Score the map of ``map_log`` (folded to ``until``) and questions from ``query_logs``.

    ``note`` is told what a reader of ``until`` might wonder about (`eventsrc.log.seek.resolve`).
    Deterministic but for ``latency_ms``, which is of exact search in memory plus the ranking.
    """
    with LogReader(map_log) as reader:
        _, view = fold_log(reader, settings, resolve(reader, until, note=note))
    keyframes = list(read_keyframes(query_logs))
    if query_logs:
        check_truth(keyframes, truth)
    plan = FloorPlan(list(read_keyframes([map_log])), keyframes, truth)
    examiner = Examiner(view, truth, camera=camera, method=method, plan=plan)
    trials = {n: examiner.ask(make_questions(keyframes, truth, n, seed)) for n in CROPS}
    scores = {
        "places": place_scores(view, truth),
        "objects": object_scores(view, truth),
        "relocalization": {str(n): summarise(found) for n, found in trials.items()},
        "method": method,
        "seed": seed,
        "offset": view.next_offset,
    }
    return Evaluation(scores, trials, view)


_ROWS = (
    ("questions", "questions"),
    ("known", "… of things in the map"),
    ("top1_room", "first place is the room"),
    ("top3_room", "… one of three is"),
    ("top1_contains_room", "first place contains it"),
    ("nearest_place", "first place is the nearest"),
    ("room_at_pose", "pose lies in the room"),
    ("pose_room", "nearest mapped pose does"),
    ("room_ceiling", "… could: room was mapped"),
    ("pose_error_m.p50", "pose error p50, m"),
    ("pose_error_m.p90", "pose error p90, m"),
    ("yaw_error_rad.p50", "yaw error p50, rad"),
    ("centroid_error_m.p50", "place's centroid p50, m"),
    ("centroid_error_m.p90", "place's centroid p90, m"),
    ("within_1_5_m", "pose within 1.5 m"),
    ("known_called_unknown", "known called unknown"),
    ("unknown_called_unknown", "unknown called unknown"),
    ("auroc", "AUROC known / unknown"),
    ("ece", "calibration error"),
    ("latency_ms.p50", "latency p50, ms"),
    ("latency_ms.p99", "latency p99, ms"),
)


def scores_text(scores: Mapping[str, Any]) -> str:
    """Places, objects, then re-localisation by number of crops."""
    lines = [_of("places", scores["places"]), _of("objects", scores["objects"]), ""]
    by_crops = scores["relocalization"]
    heads = [f"{n} crop{'s' if n != '1' else ''}" for n in by_crops]
    lines.append(f"re-localisation ({scores['method']})".ljust(28) + _row(heads))
    for path, label in _ROWS:
        values = [_text(_at(column, path)) for column in by_crops.values()]
        lines.append("  " + label.ljust(26) + _row(values))
    return "\n".join(lines) + "\n"


def _of(title: str, scores: Mapping[str, Any]) -> str:
    return f"{title}: " + ", ".join(f"{k} {_text(v)}" for k, v in scores.items())


def _row(cells: list[str]) -> str:
    return "".join(cell.rjust(10) for cell in cells)


def _at(column: Mapping[str, Any], path: str) -> Any:
    value: Any = column
    for part in path.split("."):
        value = value[part]
    return value


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
