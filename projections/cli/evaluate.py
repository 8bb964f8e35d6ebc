"""`mapfold evaluate`: how good are the places, the objects and the re-localisation.

Scores against a truth that says nothing of the map look perfect; people are told so.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from projections.evaluate import evaluate as score
from projections.evaluate import read_truth
from projections.evaluate.picture import draw_failures
from projections.evaluate.questions import DEFAULT_SEED
from projections.evaluate.run import scores_text

from .options import (
    HfovOption,
    ImageOption,
    JsonOption,
    SetOption,
    SettingsOption,
    W,
    camera_from,
    check_picture,
    settings_from,
)
from .relocalize import method_from
from .terminal import display, emit, say


def warn_of_no_truth(log: Path, scores: Mapping[str, Any] | None) -> None:
    """Say so when none of a map's keyframes and observations has truth; None is no scores."""
    if scores is None or scores["places"]["rooms"] or scores["objects"]["instances"]:
        return
    say(f"no truth for any keyframe of {log}: its places and objects are not scored; see --truth")


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
    hfov: HfovOption = 69.4,
    image: ImageOption = "640x400",
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
        settings_from(settings_file, set_),
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


def register(app: typer.Typer) -> None:
    """Add `evaluate` to the program."""
    app.command()(evaluate)
