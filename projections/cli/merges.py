"""`mapfold merges`: every merge of places, what made it and what changed hands."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from projections.history import Timeline
from projections.history.merges import merge_document
from projections.history.records import Merge
from projections.history.rendering import merge_text, merges_text

from .options import SetOption, SettingsOption, check_picture, point
from .terminal import display, emit, say
from .timeline_options import AtOption, JsonOption, LogArgument, timeline


def merges(
    log: LogArgument,
    at: AtOption = "end",
    show: Annotated[
        int | None,
        typer.Option(
            "--show", metavar="N", help="Merge number N alone, with links, objects and edges."
        ),
    ] = None,
    draw: Annotated[
        int | None,
        typer.Option("--draw", metavar="N", help="Draw merge number N, before and after."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="The picture of --draw: .png, .svg or .pdf [default: merge.png].",
        ),
    ] = None,
    json_: JsonOption = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Every merge of places, and which keyframe made it.

    When, by which keyframe, who survived, who was absorbed, and what changed hands.
    """
    if draw is None and out is not None:
        raise MisuseError(f"--out {out} is for the picture of --draw N; give --draw too")
    picture = out or Path("merge.png")
    if draw is not None:
        check_picture(picture)
    with timeline(log, settings_file, set_) as opened:
        end = point(opened.reader, at)
        found = opened.merges(end)
        if draw is not None:
            _draw(opened, numbered(found, draw), picture)
        if show is not None:
            found = [numbered(found, show)]
        if json_:
            emit([merge_document(opened.history, merge) for merge in found])
        elif show is not None:
            display(merge_text(opened.history, found[0]))
        else:
            display(merges_text(opened.history, found, end))


def _draw(opened: Timeline, merge: Merge, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.history.picture import draw_merge

    draw_merge(opened, merge, out)
    say(f"wrote {out}: merge {merge.number}, before and after")


def numbered(found: list[Merge], number: int) -> Merge:
    """The merge of this number; raises MisuseError naming those there are."""
    for merge in found:
        if merge.number == number:
            return merge
    there = f"there are 1 to {len(found)}" if found else "there are none"
    raise MisuseError(f"no merge number {number}; {there} (see `mapfold merges LOG`)")


def register(app: typer.Typer) -> None:
    """Add `merges` to the program."""
    app.command()(merges)
