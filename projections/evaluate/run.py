"""The whole evaluation: fold the map's log, ask from the query logs, score everything."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from eventsrc.log import LogReader
from eventsrc.log.whence import Note, resolve
from projections.folding import fold_log
from projections.relocalize import DEFAULT_CAMERA, Camera, Method
from projections.settings import Settings
from projections.view import MapView

from .floor_plan import FloorPlan
from .map_scores import object_scores, place_scores
from .questions import DEFAULT_SEED, check_truth, make_questions, read_keyframes
from .summary import summarise
from .trials import Examiner, Trial
from .truth import Truth

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

    ``note`` is told what a reader of ``until`` might wonder about (`eventsrc.log.whence.resolve`).
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
