"""Scores of the map's own questions; they need no truth."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from .own_questions import OwnAnswer
from .scores import auroc, calibration_floor, expected_calibration_error, percentile, reliability

Number = Callable[[OwnAnswer], float]


def own_scores(
    answers: Sequence[OwnAnswer],
    known_of: Number = lambda each: each.answer.known,
    confidence_of: Number = lambda each: each.answer.confidence,
    unknown_below: float = 0.5,
) -> dict[str, Any]:
    """Scores in the shape of ``evaluate --self --json``, for one number of crops.

    Errors are of known questions, those with the visit taken out of which something was seen at
    another time. ``taken_out_called_known`` is the share of those with the things shown taken out.
    """
    known = [each for each in answers if each.known]
    gone = [each for each in answers if each.taken_out]
    unknown = [each for each in answers if not each.known]
    in_map, sure = [known_of(each) for each in answers], [confidence_of(each) for each in answers]
    is_known, is_right = [each.known for each in answers], [each.correct for each in answers]
    return {
        "questions": len(answers),
        "known": len(known),
        "pose_error_m": _percentiles(each.error_m for each in known),
        "within_1_5_m": _share(each.correct for each in known),
        "known_called_unknown": _share(known_of(each) < unknown_below for each in known),
        "taken_out_called_known": _share(known_of(each) >= unknown_below for each in gone),
        "auroc": auroc([known_of(e) for e in known], [known_of(e) for e in unknown]),
        "known_ece": expected_calibration_error(in_map, is_known),
        "known_ece_floor": calibration_floor(in_map),
        "ece": expected_calibration_error(sure, is_right),
        "ece_floor": calibration_floor(sure),
        "known_reliability": reliability(in_map, is_known),
        "reliability": reliability(sure, is_right),
        "plain": {"pose_error_m": _percentiles(each.plain_error_m for each in known)},
        "best_cosine": {
            "auroc": auroc([e.best_cosine for e in known], [e.best_cosine for e in unknown])
        },
    }


def _percentiles(values: Iterable[float | None]) -> dict[str, float | None]:
    present = [value for value in values if value is not None]
    return {"p50": percentile(present, 0.5), "p90": percentile(present, 0.9)}


def _share(holds: Iterable[bool]) -> float | None:
    every = list(holds)
    return sum(every) / len(every) if every else None
