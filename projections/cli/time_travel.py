"""`mapfold merges`, `why`, `diff`, `bisect` and `whatif`: why a map is what it is."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from textwrap import indent
from typing import Annotated

import typer

from eventsrc.envelope import Offset
from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from eventsrc.text import counted
from projections.evaluate.truth import read_truth
from projections.history import Explanation, Expression, ExpressionError, Timeline
from projections.history.condition_functions import functions_help
from projections.history.merges import merge_document
from projections.history.records import Merge
from projections.history.rendering import (
    difference_text,
    explanation_text,
    merge_text,
    merges_text,
    search_text,
    whatif_text,
)
from projections.history.whatif import Alternative, WhatIf, alternatives, assigned, what_if

from .options import (
    JsonOption,
    LogArgument,
    SetOption,
    SettingsOption,
    W,
    check_picture,
    point,
    settings_from,
)
from .terminal import Bar, display, emit, say

MOST_LINES = 5
"""Things of a kind that a text answer names without --all."""

AllOption = Annotated[bool, typer.Option("--all", help="Name every thing, however many.")]
AtOption = Annotated[str, typer.Option("--at", metavar="W", help=f"Look from here: {W}.")]


@contextlib.contextmanager
def _timeline(log: Path, settings_file: Path | None, sets: list[str] | None) -> Iterator[Timeline]:
    """The log's timeline under the settings of the command line, with a progress bar."""
    settings = settings_from(settings_file, sets)
    with Bar() as bar, Timeline(log, settings, progress=bar.show_fold) as timeline:
        yield timeline


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

    When, by which keyframe, which place survived, which were absorbed, and what moved to the
    survivor.
    """
    if draw is None and out is not None:
        raise MisuseError(f"--out {out} is for the picture of --draw N; give --draw too")
    picture = out or Path("merge.png")
    if draw is not None:
        check_picture(picture)
    with _timeline(log, settings_file, set_) as timeline:
        end = point(timeline.reader, at)
        found = timeline.merges(end)
        if draw is not None:
            _draw_merge(timeline, _numbered(found, draw), picture)
        if show is not None:
            found = [_numbered(found, show)]
        if json_:
            emit([merge_document(timeline.history, merge) for merge in found])
        elif show is not None:
            display(merge_text(timeline.history, found[0]))
        else:
            display(merges_text(timeline.history, found, end))


def _draw_merge(timeline: Timeline, merge: Merge, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.history.picture import draw_merge

    draw_merge(timeline, merge, out)
    say(f"wrote {out}: merge {merge.number}, before and after")


def _numbered(found: list[Merge], number: int) -> Merge:
    """The merge of this number; raises MisuseError naming those there are."""
    for merge in found:
        if merge.number == number:
            return merge
    there = f"there are 1 to {len(found)}" if found else "there are none"
    raise MisuseError(f"no merge number {number}; {there} (see `mapfold merges LOG`)")


def why(
    log: LogArgument,
    thing: Annotated[
        str | None,
        typer.Argument(
            metavar="PLACE_ID|OBJECT_ID", help="A place, also an absorbed one; an object."
        ),
    ] = None,
    same: Annotated[
        tuple[str, str] | None,
        typer.Option(
            "--same",
            metavar="RUN:KF RUN:KF",
            help="Since when, and by which merges, two keyframes are in one place.",
        ),
    ] = None,
    at: AtOption = "end",
    json_: JsonOption = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """Why a place or an object is what it is, event by event."""
    if (thing is None) == (same is None):
        raise MisuseError("give one of PLACE_ID, OBJECT_ID and --same RUN:KEYFRAME RUN:KEYFRAME")
    with _timeline(log, settings_file, set_) as timeline:
        found = _explanation(timeline, thing, same, point(timeline.reader, at))
    if json_:
        emit(found.document())
    else:
        display(explanation_text(found))


def _explanation(
    timeline: Timeline, thing: str | None, same: tuple[str, str] | None, end: Offset
) -> Explanation:
    if same is not None:
        return timeline.why_same(*same, end)
    return timeline.why(thing or "", end)


def diff(
    log: LogArgument,
    first: Annotated[str, typer.Argument(metavar="W1", help=f"From here: {W}.")],
    second: Annotated[str, typer.Argument(metavar="W2", help="To here: the same.")] = "end",
    json_: JsonOption = False,
    all_: AllOption = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """What changed from one moment of the map to another.

    Keyframes, places, objects and adjacency.
    """
    with _timeline(log, settings_file, set_) as timeline:
        found = timeline.diff(point(timeline.reader, first), point(timeline.reader, second))
    if json_:
        emit(found.document())
    else:
        display(difference_text(found, most=None if all_ else MOST_LINES))


_BISECT_HELP = f"""The first event that made a condition over the map true.

EXPR compares numbers and ids, joined by and, or, not and parentheses, for example
"place_count < 3", "same_place('run:12', 'run:90')", "located_in('obj-…') == 'run_p2'";
none is no place. It may call:

\b
{indent(functions_help(), "    ")}
"""


def bisect(
    log: LogArgument,
    expression: Annotated[str, typer.Argument(metavar="EXPR", help="The condition.")],
    start: Annotated[
        str, typer.Option("--from", metavar="W", help=f"Begin with the map as of here: {W}.")
    ] = "0",
    end: Annotated[
        str, typer.Option("--to", metavar="W", help="End with the map as of here.")
    ] = "end",
    scan: Annotated[
        bool,
        typer.Option("--scan", help="List every turn to true and to false, not only the first."),
    ] = False,
    json_: JsonOption = False,
    all_: AllOption = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    with _columns_shown(), _timeline(log, settings_file, set_) as timeline:
        asked = Expression(expression)
        span = point(timeline.reader, start), point(timeline.reader, end)
        found = timeline.bisect(asked, *span, scan=scan)
    if json_:
        emit(found.document())
    else:
        display(search_text(found, most=None if all_ else MOST_LINES))


@contextlib.contextmanager
def _columns_shown() -> Iterator[None]:
    """Show where an expression is wrong, above the line that says why."""
    try:
        yield
    except ExpressionError as error:
        say(error.pointer)
        raise


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
    with Bar() as bar:
        found = what_if(
            log, common, others, end,
            truth=scored, processes=processes, progress=bar.show_fold,
            keep_views=picture is not None,
        )  # fmt: skip
    from .evaluate import warn_of_no_truth  # here: it imports all of re-localisation

    warn_of_no_truth(log, found.base.result.scores)
    if picture is not None:
        _draw_maps(found, picture)
    if json_:
        emit(found.document())
    else:
        display(whatif_text(found, most=None if all_ else MOST_LINES))


def _draw_maps(found: WhatIf, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.history.picture import draw_maps

    maps = [(_title(each), each.result.view) for each in found.all]
    draw_maps([(title, view) for title, view in maps if view is not None], out)
    say(f"wrote {out}: {counted(len(maps), 'map')}")


def _title(each: Alternative) -> str:
    counts = each.result.counts
    return f"{each.name}: {counted(counts['places'], 'place')}, {counts['noise']} noise"


def register(app: typer.Typer) -> None:
    """Add these commands to the program."""
    app.command()(merges)
    app.command()(why)
    app.command()(diff)
    app.command(help=_BISECT_HELP)(bisect)
    app.command()(whatif)
