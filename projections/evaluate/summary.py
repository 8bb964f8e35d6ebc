"""Trials to numbers.

Accuracy and errors are over *known* questions (some true instance of theirs is in the map), errors
over those that have a pose. ``auroc`` is that of confidence between known and unknown questions.
Calibration counts all questions: an answer is right when the question is known and the pose is
within 1.5 m of the truth.
"""

from collections.abc import Callable, Sequence
from typing import Any

from .calibration import auroc, expected_calibration_error, percentile, reliability
from .trials import Trial

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
