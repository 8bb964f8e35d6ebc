"""`mapfold evaluate`: scores of places, objects and re-localisation."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import counted, visible
from projections.localize.evaluate.evaluation import draw_failures
from projections.localize.evaluate.evaluation import evaluate as score
from projections.localize.evaluate.questions import DEFAULT_SEED
from projections.localize.evaluate.truth import read_truth
from projections.localize.relocalize import Method
from projections.map.parsed_log import DEFAULT_WORKERS, MAX_WORKERS

from .folded_log import FoldSettings, W, warn_of_no_truth
from .options import CameraOptions, JsonOption, check_picture, method_from, option
from .terminal import display, emit, say

_ROWS = (
    ("questions", "questions"),
    ("known", "… of things in the map"),
    ("top1_room", "first place is the room"),
    ("top3_room", "… one of three is"),
    ("top1_contains_room", "first place contains it"),
    ("nearest_place", "first place is the nearest"),
    ("room_at_pose", "pose lies in the room"),
    ("pose_room", "nearest mapped pose in it"),
    ("room_ceiling", "… if the room was mapped"),
    ("pose_error_m.p50", "pose error p50, m"),
    ("pose_error_m.p90", "pose error p90, m"),
    ("plain.pose_error_m.p50", "… of the plain baseline, p50"),
    ("plain.pose_error_m.p90", "… of the plain baseline, p90"),
    ("yaw_error_rad.p50", "yaw error p50, rad"),
    ("centroid_error_m.p50", "place's centroid p50, m"),
    ("centroid_error_m.p90", "place's centroid p90, m"),
    ("within_1_5_m", "pose within 1.5 m"),
    ("plain.within_1_5_m", "… of the plain baseline"),
    ("known_called_unknown", "known called unknown"),
    ("unknown_called_unknown", "unknown called unknown"),
    ("auroc", "AUROC known / unknown"),
    ("best_cosine.auroc", "… of the best cosine"),
    ("known_ece", "calib. error of known"),
    ("known_ece_floor", "… expected if calibrated"),
    ("ece", "calib. error of confidence"),
    ("ece_floor", "… expected if calibrated"),
    ("latency_ms.p50", "latency p50, ms"),
    ("latency_ms.p99", "latency p99, ms"),
)
_OWN_ROWS = (
    ("questions", "questions"),
    ("known", "… of things seen before"),
    ("pose_error_m.p50", "pose error p50, m"),
    ("pose_error_m.p90", "pose error p90, m"),
    ("plain.pose_error_m.p50", "… of the plain baseline, p50"),
    ("plain.pose_error_m.p90", "… of the plain baseline, p90"),
    ("within_1_5_m", "pose within 1.5 m"),
    ("known_called_unknown", "known called unknown"),
    ("taken_out_called_known", "taken out, called known"),
    ("auroc", "AUROC known / unknown"),
    ("best_cosine.auroc", "… of the best cosine"),
    ("known_ece", "calib. error of known"),
    ("known_ece_floor", "… expected if calibrated"),
    ("ece", "calib. error of confidence"),
    ("ece_floor", "… expected if calibrated"),
)
_FLOOR_ROWS = (
    ("known", "questions of known things"),
    ("pose_error_m.p50", "pose error p50, m"),
    ("within_1_5_m", "pose within 1.5 m"),
    ("wrong_floor", "on another floor"),
)
_LABEL = 30


def evaluate(
    *,
    map_logs: Annotated[list[Path], option("LOG", "Log of a map; may be repeated.", "--map")],
    query_logs: Annotated[
        list[Path] | None,
        option("LOG", "Log whose keyframes are the questions; may be repeated.", "--query"),
    ] = None,
    truth_files: Annotated[
        list[Path] | None, option("FILE", "Ground truth of runs; may be repeated.", "--truth")
    ] = None,
    until: Annotated[str, option("W", f"Fold the map's log only to here: {W}.", "--at")] = "end",
    method: Annotated[
        str, option("joint|plain", "As for `mapfold relocalize`.", "--method")
    ] = "joint",
    seed: Annotated[int, option("N", "Seed of the choice of crops.", "--seed")] = DEFAULT_SEED,
    camera: CameraOptions,
    self_: Annotated[
        bool,
        typer.Option("--self", help="Ask the map about its own keyframes too; needs no truth."),
    ] = False,
    picture: Annotated[
        Path | None,
        option("FILE", "Draw the questions of three crops, and the error of each.", "--picture"),
    ] = None,
    chosen: FoldSettings,
    workers: Annotated[
        int | None,
        option(
            "N",
            "Processes that ask beside this one. Default: as many as there are further"
            f" processors, at most {DEFAULT_WORKERS}.",
            "--workers",
            min=0,
            max=MAX_WORKERS,
        ),
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Score places, objects and re-localisation against ground truth.

    Re-localisation is scored with one to five crops a question, and with one to five pictures
    (views) of up to three crops. Beside them are the scores of the plain baseline (the median
    position of the ten most similar observations) and of the best cosine alone. With several maps
    each is asked every question, and the worst one is named.

    With --self the map is asked about its own keyframes, each without the observations of its
    visit in the map.
    """
    check_picture(picture)
    if picture is not None and len(map_logs) > 1:
        raise MisuseError("--picture draws one map; give one --map")
    asked = bool(query_logs or truth_files) or not self_
    if not asked:
        _refuse_alone(method_from(method), camera)
    truth, settings = read_truth(truth_files or []), chosen.checked()
    found = []
    for map_log in map_logs:
        result = score(
            map_log,
            query_logs or [],
            truth,
            settings,
            until=until,
            method=method_from(method),
            camera=camera.camera,
            seed=seed,
            own=self_,
            workers=workers,
            note=say,
        )
        if asked:
            warn_of_no_truth(map_log, result.scores)
        found.append((map_log, result.scores))
    if json_:
        emit(_document(found))
    else:
        _print_scores(found, asked=asked)
    if picture is not None:  # last: the scores are printed if it cannot be written
        draw_failures(result.view, result.trials[3], picture)


def _print_scores(found: "_Scored", *, asked: bool) -> None:
    for map_log, scores in found:
        title = f"{map_log}\n" if len(found) > 1 else ""
        display(title + (scores_text(scores) if asked else "") + own_text(scores))
    if len(found) > 1:
        display(worst_text(found))


def _refuse_alone(method: Method, camera: CameraOptions) -> None:
    """Raise MisuseError for options that questions of the map's own do not read."""
    given = {
        "--method plain": method == "plain",
        "--hfov": camera.hfov is not None,
        "--image": camera.image is not None,
    }
    unread = [option for option, is_given in given.items() if is_given]
    if unread:
        raise MisuseError(
            f"{' and '.join(unread)}: --self alone asks by the method joint, which it compares with"
            " the plain one, and with the camera of each picture; leave it out, or ask from"
            " --query too"
        )


_Scored = Sequence[tuple[Path, Mapping[str, Any]]]
_JUDGED_BY = "3"
"""Number of crops of the questions by which the worst map is chosen; for a map without such
questions its smallest number."""


class Judged(NamedTuple):
    """A map with its errors and the plain baseline's, for questions of ``crops`` crops."""

    log: Path
    crops: str
    ours: Mapping[str, Any]
    plain: Mapping[str, Any]

    @property
    def ratio(self) -> float:
        """The ratio of the median error to the plain baseline's."""
        return float(self.ours["p50"] / self.plain["p50"])


def _document(found: _Scored) -> Mapping[str, Any]:
    """The scores of one map; for several maps those of each, and the worst map."""
    if len(found) == 1:
        return found[0][1]
    worst = worst_of(found)
    return {
        "maps": [{"map": str(log), **scores} for log, scores in found],
        "worst": None if worst is None else str(worst.log),
    }


def worst_of(found: _Scored) -> Judged | None:
    """The map whose median error is greatest relative to the plain baseline's; by the maps' own
    questions if there are no other questions about known things."""
    return _worst_by("relocalization", found) or _worst_by("self", found)


def _worst_by(group: str, found: _Scored) -> Judged | None:
    judged = [_judged(log, scores[group]) for log, scores in found if group in scores]
    return max((each for each in judged if each), key=lambda each: each.ratio, default=None)


def _judged(log: Path, columns: Mapping[str, Any]) -> Judged | None:
    """A map judged by some scores; None if no question has errors to compare."""
    for crops in sorted(columns, key=lambda crops: (crops != _JUDGED_BY, int(crops))):
        ours, plain = columns[crops]["pose_error_m"], columns[crops]["plain"]["pose_error_m"]
        if ours["p50"] is not None and plain["p50"]:
            return Judged(log, crops, ours, plain)
    return None


def worst_text(found: _Scored) -> str:
    """A line that names the worst map."""
    worst = worst_of(found)
    if worst is None:
        return "no map was asked about things that it has\n"
    return (
        f"worst map: {worst.log}, {counted(int(worst.crops), 'crop')}: pose error p50"
        f" {worst.ours['p50']:.2f} m, the plain baseline's {worst.plain['p50']:.2f} m\n"
    )


def scores_text(scores: Mapping[str, Any]) -> str:
    """The scores as a table: places, objects, then re-localisation by number of crops and views."""
    lines = [_score_line("places", scores["places"], scores["places"]["rooms"], "room")]
    lines += [_score_line("objects", scores["objects"], scores["objects"]["instances"], "instance")]
    columns = {
        counted(int(n), word): column
        for word, group in (("crop", "relocalization"), ("view", "views"))
        for n, column in scores[group].items()
    }
    lines += ["", f"re-localisation ({scores['method']})".ljust(_LABEL) + _cells(list(columns))]
    lines += _rows(_ROWS, columns)
    floors = sorted({floor for column in columns.values() for floor in column["floors"]})
    if floors:
        lines += _rows((("wrong_floor", "on another floor"),), columns)
    for floor in floors:
        of_floor = {name: column["floors"].get(floor, {}) for name, column in columns.items()}
        lines += [f"  from floor {visible(floor)}"]
        lines += _rows(_FLOOR_ROWS, of_floor)
    return "\n".join(lines) + "\n"


def own_text(scores: Mapping[str, Any]) -> str:
    """The scores of the map's own questions as a table, if it was asked any."""
    if "self" not in scores:
        return ""
    columns = {counted(int(n), "crop"): column for n, column in scores["self"].items()}
    lines = ["the map's own questions".ljust(_LABEL) + _cells(list(columns))]
    return "\n".join([*lines, *_rows(_OWN_ROWS, columns)]) + "\n"


def _rows(rows: Sequence[tuple[str, str]], columns: Mapping[str, Any]) -> Iterator[str]:
    for path, label in rows:
        values = [_cell(_value_at(column, path)) for column in columns.values()]
        yield "  " + label.ljust(_LABEL - 2) + _cells(values)


def _score_line(title: str, scores: Mapping[str, Any], known: int, of: str) -> str:
    if not known:
        return f"{title}: number {scores['number']}, no {of} truth"
    return f"{title}: " + ", ".join(f"{k} {_cell(v)}" for k, v in scores.items())


def _cells(cells: list[str]) -> str:
    return "".join(cell.rjust(10) for cell in cells)


def _value_at(column: Mapping[str, Any], path: str) -> Any:
    value: Any = column
    for part in path.split("."):
        value = None if value is None else value.get(part)
    return value


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)
