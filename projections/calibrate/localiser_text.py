"""What a calibration says of re-localisation: how the map would do on its own questions."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from eventsrc.text import counted
from projections.evaluate.own_scores import own_scores
from projections.history.rendering import table
from projections.relocalize import UNKNOWN_BELOW

from .localiser import CROPS, OwnScores

_EDGES = (0.0, 0.25, 0.5, 0.75, 1.0)
_DECIMALS = 6
FEW = 20
"""Known questions below which the figures say little."""


def localiser_document(own: OwnScores) -> dict[str, Any]:
    """JSON: scores with the correction, by number of crops, and the correction as it is set.

    Scores have six decimals; beyond, machines may differ in the errors and in `confidence`."""
    constants = own.constants.model_dump(exclude={"text_shift"})
    return {
        "questions": {str(crops): _rounded(_scores(own, crops)) for crops in CROPS},
        "constants": {f"localizer.{name}": value for name, value in constants.items()},
    }


def localiser_text(own: OwnScores) -> str:
    """Two tables: errors and shares, and how often what was said was right."""
    if not own.answers:
        return "re-localisation: no keyframe to ask from\n"
    rows = [
        (
            counted(crops, "crop"),
            str(scores["questions"] // 2),
            str(scores["known"]),
            _number(scores["pose_error_m"]["p50"]),
            _number(scores["pose_error_m"]["p90"]),
            _number(scores["plain"]["pose_error_m"]["p50"]),
            _number(scores["within_1_5_m"]),
            _number(scores["known_called_unknown"]),
            _number(scores["taken_out_called_known"]),
        )
        for crops in CROPS
        if (scores := _scores(own, crops))["questions"]
    ]
    header = (
        "re-localisation", "asked", "known", "p50 m", "p90 m", "plain p50", "within 1.5 m",
        "called unknown", "taken out, called known",
    )  # fmt: skip
    bins = [f"said {low:g} to {high:g}" for low, high in pairwise(_EDGES)]
    known = ("known", *_right([(own.known(a), a.known) for a in own.answers]))
    sure = ("confidence", *_right([(own.confidence(a), a.correct) for a in own.answers]))
    text = table(header, rows, right=header[1:])
    text += table(("right, of how many", *bins), [known, sure], right=bins)
    count = sum(answer.known for answer in own.answers)
    if count < FEW:
        seen = "question" if count == 1 else "questions"
        text += (
            f"{count} {seen} about what was seen at another time: the figures say little, and"
            " re-localisation's numbers stay near those of other maps\n"
        )
    return text


def _scores(own: OwnScores, crops: int) -> dict[str, Any]:
    answers = [each for each in own.answers if each.crops == crops]
    return own_scores(answers, own.known, own.confidence, UNKNOWN_BELOW)


def _rounded(document: Any) -> Any:
    """A JSON document with the decimals that are told."""
    if isinstance(document, dict):
        return {key: _rounded(value) for key, value in document.items()}
    if isinstance(document, list):
        return [_rounded(value) for value in document]
    return round(document, _DECIMALS) if isinstance(document, float) else document


def _right(said: Sequence[tuple[float, bool]]) -> list[str]:
    """For each bin the share that was right, and how many there are."""
    cells = []
    for low, high in pairwise(_EDGES):
        right = [each for p, each in said if low <= p < high or p == high == 1.0]
        cells.append(f"{sum(right) / len(right):.2f} of {len(right)}" if right else "-")
    return cells


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
