"""`mapfold evaluate`: how good are the places, the objects and the re-localisation."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from projections.evaluate import evaluate as score
from projections.evaluate import read_truth
from projections.evaluate.picture import draw_failures
from projections.evaluate.questions import DEFAULT_SEED

from .options import (
    HfovOption,
    ImageOption,
    JsonOption,
    SetOption,
    SettingsOption,
    W,
    camera_from,
    check_picture,
    settings_of,
)
from .relocalize import method_from
from .terminal import display, emit, say

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


def evaluate(
    map_log: Annotated[Path, typer.Option("--map", metavar="LOG", help="Log the map is made of.")],
    query_logs: Annotated[
        list[Path] | None,
        typer.Option("--query", metavar="LOG", help="Log to ask from; several are fine."),
    ] = None,
    truth_files: Annotated[
        list[Path] | None,
        typer.Option("--truth", metavar="FILE", help="Truth of map and query runs; several."),
    ] = None,
    until: Annotated[
        str, typer.Option("--at", metavar="W", help=f"Fold the map's log only to here: {W}.")
    ] = "end",
    method: Annotated[str, typer.Option("--method", help="joint or plain.")] = "joint",
    seed: Annotated[int, typer.Option("--seed", help="Draws the crops asked with.")] = DEFAULT_SEED,
    hfov: HfovOption = None,
    image: ImageOption = None,
    picture: Annotated[
        Path | None,
        typer.Option("--picture", metavar="FILE", help="Draw where three crops fail."),
    ] = None,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
    json_: JsonOption = False,
) -> None:
    """How good places, objects and re-localisation are.

    Scores against the truth, of re-localisation with one, two and three crops a question.
    """
    check_picture(picture)
    result = score(
        map_log,
        query_logs or [],
        read_truth(truth_files or []),
        settings_of(settings_file, set_),
        until=until,
        method=method_from(method),
        camera=camera_from(hfov, image),
        seed=seed,
        note=say,
    )
    warn_of_no_truth(map_log, result.scores)
    if json_:
        emit(result.scores)
    else:
        display(scores_text(result.scores))
    if picture is not None:
        draw_failures(result.view, result.trials[3], picture)


def warn_of_no_truth(log: Path, scores: Mapping[str, Any] | None) -> None:
    """Say so when none of a map's keyframes and observations has truth; None is no scores.

    Without the warning the scores of nothing look perfect.
    """
    if scores is None or scores["places"]["rooms"] or scores["objects"]["instances"]:
        return
    say(f"no truth for any keyframe of {log}: its places and objects are not scored; see --truth")


def scores_text(scores: Mapping[str, Any]) -> str:
    """The scores as a table: places, objects, then re-localisation by number of crops."""
    lines = [_score_line("places", scores["places"]), _score_line("objects", scores["objects"]), ""]
    by_crops = scores["relocalization"]
    heads = [f"{n} crop{'s' if n != '1' else ''}" for n in by_crops]
    lines.append(f"re-localisation ({scores['method']})".ljust(28) + _cells(heads))
    for path, label in _ROWS:
        values = [_cell(_value_at(column, path)) for column in by_crops.values()]
        lines.append("  " + label.ljust(26) + _cells(values))
    return "\n".join(lines) + "\n"


def _score_line(title: str, scores: Mapping[str, Any]) -> str:
    return f"{title}: " + ", ".join(f"{k} {_cell(v)}" for k, v in scores.items())


def _cells(cells: list[str]) -> str:
    return "".join(cell.rjust(10) for cell in cells)


def _value_at(column: Mapping[str, Any], path: str) -> Any:
    value: Any = column
    for part in path.split("."):
        value = value[part]
    return value


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def register(app: typer.Typer) -> None:
    """Add `evaluate` to the program."""
    app.command()(evaluate)
