"""`mapfold evaluate`: how good are the places, the objects and the re-localisation."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.cli._shell import display, emit, say
from projections.cli._options import SetOption, SettingsOption, settings_from
from projections.cli._picture import check_picture
from projections.cli._point import W
from projections.cli._question import HfovOption, ImageOption, camera_from
from projections.cli._truth import warn_of_no_truth
from projections.cli.relocalize import method_from
from projections.evaluate import evaluate as score
from projections.evaluate import read_truth
from projections.evaluate.picture import draw_failures
from projections.evaluate.questions import DEFAULT_SEED
from projections.evaluate.text import scores_text


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
    json_: Annotated[bool, typer.Option("--json", help="The scores as JSON on stdout.")] = False,
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
