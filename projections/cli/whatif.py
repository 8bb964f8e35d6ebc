"""`mapfold whatif`: the same log under other settings, side by side."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from eventsrc.text import counted
from projections.evaluate.truth import read_truth
from projections.history.rendering import whatif_text
from projections.history.whatif import Alternative, WhatIf, alternatives, assigned, what_if

from .evaluate import warn_of_no_truth
from .options import SettingsOption, check_picture, point, settings_from
from .terminal import display, emit, say
from .timeline_options import MOST_LINES, AllOption, AtOption, FoldBar, JsonOption, LogArgument


def whatif(
    log: LogArgument,
    set_: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Change a setting; all --set make one alternative, and hold for all of a --grid.",
        ),
    ] = None,
    try_: Annotated[
        list[str] | None,
        typer.Option(
            "--try",
            metavar="'NAME=VALUE …'",
            help="One alternative of its own; give it several times for several.",
        ),
    ] = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--grid",
            metavar="NAME=VALUE,…",
            help="Every combination of these values, with those of other --grid.",
        ),
    ] = None,
    base: Annotated[
        str,
        typer.Option(
            metavar="'NAME=VALUE …'", help="Compare with these settings instead of the defaults."
        ),
    ] = "",
    at: AtOption = "end",
    truth: Annotated[
        list[Path] | None,
        typer.Option(
            "--truth", metavar="FILE", help="Score places and objects against this ground truth."
        ),
    ] = None,
    json_: JsonOption = False,
    all_: AllOption = False,
    picture: Annotated[
        Path | None,
        typer.Option(
            "--picture", metavar="FILE", help="Draw the maps side by side (.png, .svg, .pdf)."
        ),
    ] = None,
    processes: Annotated[
        int | None,
        typer.Option(metavar="N", min=1, help="Fold in this many processes [default: processors]."),
    ] = None,
    settings_file: SettingsOption = None,
) -> None:
    """What the map would be under other settings.

    Places, noise, merges and objects under each, and how the maps differ. ARI is the adjusted Rand
    index against the base: 1 is the same partition of keyframes into places or observations into
    objects, 0 no better than chance, and so is any difference from a base of one single place. With
    --truth, V is the V-measure against rooms and instances: 1 is perfect.
    """
    common = assigned(settings_from(settings_file, None), base, "--base")
    others = alternatives(common, set_ or (), try_ or (), grid or ())
    check_picture(picture)
    if not others:
        raise MisuseError("nothing to try; give --set eps_m=1.0, --try or --grid eps_m=0.5,1.0")
    scored = read_truth(truth) if truth else None
    with LogReader(log) as reader:
        end = point(reader, at)
    with FoldBar() as bar:
        found = what_if(
            log, common, others, end,
            truth=scored, processes=processes, progress=bar, keep_views=picture is not None,
        )  # fmt: skip
    warn_of_no_truth(log, found.base.outcome.scores)
    if picture is not None:
        _draw(found, picture)
    if json_:
        emit(found.document())
    else:
        display(whatif_text(found, most=None if all_ else MOST_LINES))


def _draw(found: WhatIf, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.history.picture import draw_maps

    maps = [(_title(each), each.outcome.view) for each in found.all]
    draw_maps([(title, view) for title, view in maps if view is not None], out)
    say(f"wrote {out}: {counted(len(maps), 'map')}")


def _title(each: Alternative) -> str:
    counts = each.outcome.counts
    return f"{each.name}: {counted(counts['places'], 'place')}, {counts['noise']} noise"


def register(app: typer.Typer) -> None:
    """Add `whatif` to the program."""
    app.command()(whatif)
