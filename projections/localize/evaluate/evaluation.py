"""The evaluation: fold the map's log, ask questions from the query logs, score everything.

Accuracy and errors are over *known* questions (some true instance of theirs is in the map), errors
over those that have a pose; one on another floor than the question's is wrong, and its error has no
bound. ``auroc`` is that of `known` between known and unknown questions.
Calibration counts all questions: an answer is right when the question is known and the pose is
within 1.5 m of the truth. ``plain`` and ``best_cosine`` are simple baselines (`trials`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import chain, islice
from pathlib import Path
from typing import Any

from eventsrc.base.user_files import write_files
from eventsrc.log import LogReader
from eventsrc.log.seek import Note, resolve
from projections.fold.corrections import Corrections
from projections.fold.settings import CameraConstants, Settings
from projections.localize.relocalize import Method
from projections.map.fold import fold_log
from projections.map.parsed_log import default_workers
from projections.map.parsing import read_corrections
from projections.map.view import MapView

from .own_questions import ask_own_questions, own_scores
from .questions import (
    DEFAULT_SEED,
    check_truth,
    make_questions,
    make_view_questions,
    read_keyframes,
    spread,
)
from .scores import (
    auroc,
    calibration_floor,
    expected_calibration_error,
    object_scores,
    percentile,
    percentiles,
    place_scores,
    reliability,
    share,
)
from .trials import RIGHT_WITHIN_M, RoomIndex, Trial, TrialRunner
from .truth import Truth

CROPS, VIEWS = (1, 2, 3, 5), (1, 3, 5)
MOST_VIEWS = 200
"""The most questions of each number of views, spread evenly; they take longer."""
OWN_CROPS = (1, 3)


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
    settings: Settings | Callable[[Corrections], Settings],
    *,
    until: str = "end",
    method: Method = "joint",
    camera: CameraConstants | None = None,
    seed: int = DEFAULT_SEED,
    own: bool = False,
    workers: int | None = None,
    note: Note | None = None,
) -> Evaluation:
    """Score the map of ``map_log`` (folded to ``until`` under its corrections) and questions from
    ``query_logs``. ``settings`` may depend on the log's corrections. With ``own`` the map is asked
    questions of its own too, which need no truth. ``workers`` is how many processes may ask many
    questions beside this one, 0 for none, by default `default_workers`; the scores do not depend on
    it.

    ``note`` is called with remarks for the user about ``until`` (`eventsrc.log.seek.resolve`), and
    when a process has died. Deterministic but for ``latency_ms``, which is of exact search in
    memory plus the ranking.
    """
    with LogReader(map_log) as reader:
        end = resolve(reader, until, note=note)
        corrections = read_corrections(reader, end)
        if not isinstance(settings, Settings):
            settings = settings(corrections)
        _, view = fold_log(reader, settings, end, corrections=corrections)
    keyframes, height_m = list(read_keyframes(query_logs, settings)), settings.floor_height_m
    if query_logs:
        check_truth(keyframes, truth)
    # Damage before `end` has been raised by the fold.
    mapped = list(read_keyframes([map_log], on_gap=lambda _: None, corrections=corrections))
    rooms = RoomIndex(mapped, keyframes, truth, height_m)
    runner = TrialRunner(view, truth, camera=camera, method=method, room_index=rooms)
    if workers is None:
        workers = default_workers()
    asked = [make_questions(keyframes, truth, n, seed, height_m) for n in CROPS]
    asked += [
        spread(make_view_questions(keyframes, truth, n, seed, height_m), MOST_VIEWS) for n in VIEWS
    ]
    answered = iter(runner.run(chain.from_iterable(asked), workers, note))
    each = [list(islice(answered, len(questions))) for questions in asked]
    trials = dict(zip(CROPS, each, strict=False))
    views = dict(zip(VIEWS, each[len(CROPS) :], strict=True))
    scores: dict[str, Any] = {
        "places": place_scores(view, truth),
        "objects": object_scores(view, truth),
        "relocalization": {str(n): _summarise(found) for n, found in trials.items()},
        "views": {str(n): _summarise(found) for n, found in views.items()},
        "method": method,
        "seed": seed,
        "offset": view.next_offset,
    }
    if own:
        scores["self"] = {
            str(crops): own_scores(
                ask_own_questions(view, crops, seed=seed, workers=workers, note=note)
            )
            for crops in OWN_CROPS
        }
    return Evaluation(scores, trials, view)


def _summarise(trials: Sequence[Trial]) -> dict[str, Any]:
    """Scores of re-localisation with one number of crops."""
    known = [t for t in trials if t.known]
    unknown = [t for t in trials if not t.known]
    roomed = [t for t in known if t.question.room is not None]
    confidence = [t.answer.confidence for t in trials]
    in_map = [t.answer.known for t in trials]
    correct = [t.correct for t in trials]
    return {
        "questions": len(trials),
        "known": len(known),
        "top1_room": share(t.question.room in t.rooms_of_places[:1] for t in roomed),
        "top3_room": share(t.question.room in t.rooms_of_places[:3] for t in roomed),
        "top1_contains_room": share(any(t.contains[:1]) for t in roomed),
        "top3_contains_room": share(any(t.contains[:3]) for t in roomed),
        "pose_room": share(t.question.room == t.room_of_pose for t in roomed),
        "room_at_pose": share(t.question.room == t.room_at_pose for t in roomed),
        "room_ceiling": share(t.room_has_place for t in roomed),
        "nearest_place": share(t.nearest_place for t in known if t.nearest_place is not None),
        "pose_error_m": percentiles(t.pose_error_m for t in known),
        "yaw_error_rad": percentiles(t.yaw_error_rad for t in known),
        "centroid_error_m": percentiles(t.centroid_error_m for t in known),
        "within_1_5_m": share(t.correct for t in known),
        "wrong_floor": share(t.wrong_floor for t in known if t.wrong_floor is not None),
        "known_called_unknown": share(t.answer.unknown for t in known),
        "unknown_called_unknown": share(t.answer.unknown for t in unknown),
        "auroc": auroc([t.answer.known for t in known], [t.answer.known for t in unknown]),
        "ece": expected_calibration_error(confidence, correct),
        "ece_floor": calibration_floor(confidence),
        "known_ece": expected_calibration_error(in_map, [t.known for t in trials]),
        "known_ece_floor": calibration_floor(in_map),
        "reliability": reliability(confidence, correct),
        "plain": {
            "pose_error_m": percentiles(t.plain_error_m for t in known),
            "within_1_5_m": share(_plain_is_near(t) for t in known),
        },
        "best_cosine": {
            "auroc": auroc([t.best_cosine for t in known], [t.best_cosine for t in unknown])
        },
        "floors": {floor: _of_floor(known, floor) for floor in _floors(known)},
        "latency_ms": _latency(trials),
    }


def _floors(trials: Sequence[Trial]) -> list[str]:
    return sorted({t.question.floor for t in trials if t.question.floor is not None})


def _of_floor(known: Sequence[Trial], floor: str) -> dict[str, Any]:
    """Scores of the known questions from one floor."""
    here = [t for t in known if t.question.floor == floor]
    return {
        "known": len(here),
        "within_1_5_m": share(t.correct for t in here),
        "wrong_floor": share(t.wrong_floor for t in here if t.wrong_floor is not None),
        "pose_error_m": percentiles(t.pose_error_m for t in here),
    }


def _plain_is_near(trial: Trial) -> bool:
    return trial.plain_error_m is not None and trial.plain_error_m <= RIGHT_WITHIN_M


def _latency(trials: Sequence[Trial]) -> dict[str, float | None]:
    milliseconds = [t.seconds * 1000.0 for t in trials]
    return {"p50": percentile(milliseconds, 0.5), "p99": percentile(milliseconds, 0.99)}


_GOOD, _BAD, _UNKNOWN, _DRIVE = "#2a7f62", "#c0392b", "#8e8e8e", "#d9d9d9"


def draw_failures(view: MapView, trials: Sequence[Trial], out: Path) -> None:
    """Draw each question's true position, and a line to a wrong answer, to ``out`` (.png, .svg or
    .pdf). Raises MisuseError where no file can be made there, MapfoldError where writing it
    fails."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    drive = [k.pose for k in view.keyframes if k.pose is not None]
    axes.scatter([p.x_um / 1e6 for p in drive], [p.y_um / 1e6 for p in drive], 6, _DRIVE)
    for trial in trials:
        if trial.known:
            _draw(axes, trial)
    known = [t for t in trials if t.known]
    axes.set_title(
        f"{sum(t.correct for t in known)} of {len(known)} poses within 1.5 m", loc="left"
    )
    axes.set_xlabel(
        "green: within 1.5 m   red: not, with a line to the answer   grey: answered 'unknown'"
    )
    axes.set_aspect("equal")
    picture = BytesIO()
    figure.savefig(picture, format=out.suffix[1:])
    write_files({out: picture.getvalue()})


def _draw(axes: object, trial: Trial) -> None:
    question, pose = trial.question, trial.answer.pose
    colour = _GOOD if trial.correct else _UNKNOWN if trial.answer.unknown else _BAD
    if pose is not None and not trial.correct:
        axes.plot(  # type: ignore[attr-defined]
            [question.x, pose.x], [question.y, pose.y], color=colour, linewidth=0.7, alpha=0.6
        )
    axes.scatter([question.x], [question.y], 12, colour)  # type: ignore[attr-defined]
