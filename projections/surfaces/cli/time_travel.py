"""`mapfold merges`, `why`, `diff`, `changes` and `bisect`: why a map is what it is."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from textwrap import indent
from typing import Annotated

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, shorten_by, visible
from eventsrc.envelope.model import Offset
from projections.ask.best_views import write_views
from projections.ask.what_changed import changes_text
from projections.history import Explanation, Expression, ExpressionError, KnownHistory, LogTimeline
from projections.history.condition_functions import functions_help
from projections.history.diff_rendering import difference_text
from projections.history.merge_reasons import (
    merge_document,
    object_merge_document,
    refusal_document,
)
from projections.history.rendering import (
    explanation_text,
    merge_text,
    merges_text,
    object_merges_text,
    refusals_text,
    search_text,
)
from projections.map.frames import frames_of, frames_text
from projections.store.history_records import Merge

from . import folded_log
from .options import JsonOption, check_picture, option
from .terminal import Bar, display, emit, say


@dataclass(frozen=True, kw_only=True)
class PastLog(folded_log.CachedLog):
    """The log whose past is asked."""

    @contextlib.contextmanager
    def timeline(self) -> Iterator[LogTimeline]:
        """Its timeline under the settings of the command line or the log, with a progress bar."""
        settings, cache = self.checked(), not self.no_cache
        with (
            Bar() as bar,
            LogTimeline(
                self.log, settings, progress=bar.show_fold, note=say, cache=cache
            ) as timeline,
        ):
            yield timeline

    @contextlib.contextmanager
    def known(self, at: str, known_at: str | None) -> Iterator[tuple[KnownHistory, Offset]]:
        """Its history under the commands of ``--known-at``, and the offset that W means."""
        with self.timeline() as timeline:
            end = folded_log.point(timeline.reader, at)
            known = timeline.knowing(folded_log.known_point(timeline.reader, known_at, end))
            shorten_by(partial(known.shortened, end=end))
            yield known, end


def merges(
    *,
    at: folded_log.AtOption = "end",
    show: Annotated[
        int | None, option("N", "Merge number N alone, with links, objects and edges.", "--show")
    ] = None,
    draw: Annotated[
        int | None, option("N", "Draw merge number N, before and after.", "--draw")
    ] = None,
    out: Annotated[
        Path | None,
        option("FILE", "The picture of --draw: .png, .svg or .pdf [default: merge.png]."),
    ] = None,
    refused: Annotated[
        bool,
        typer.Option(
            "--refused", help="Show instead the merges that a command refused, and the command."
        ),
    ] = False,
    objects: Annotated[
        bool, typer.Option("--objects", help="Show instead the objects that became one, and why.")
    ] = False,
    frames: Annotated[
        bool,
        typer.Option(
            "--frames", help="Show instead the map frames: joined by which command, or held apart."
        ),
    ] = False,
    known_at: folded_log.KnownAtOption = None,
    json_: JsonOption = False,
    past: PastLog,
) -> None:
    """List every merge of places, and which keyframe made it.

    With its time, the place that survived, the places that were absorbed, and what moved to the
    survivor.
    """
    if refused + objects + frames + (show is not None or draw is not None) > 1:
        raise MisuseError(
            "--refused, --objects and --frames are tables of their own; give one alone"
        )
    if draw is None and out is not None:
        raise MisuseError(f"--out {out} is for the picture of --draw N; give --draw too")
    picture = out or Path("merge.png")
    if draw is not None:
        check_picture(picture)
    with past.known(at, known_at) as (known, end):
        if refused:
            _show_refusals(known, end, json_=json_)
            return
        if objects:
            _show_object_merges(known, end, json_=json_)
            return
        if frames:
            met = frames_of(known.at(end))
            emit([each.document() for each in met]) if json_ else display(frames_text(met))
            return
        found = known.merges(end)
        if draw is not None:
            _draw_merge(known, _numbered(found, draw), picture)
        if show is not None:
            found = [_numbered(found, show)]
        if json_:
            emit([merge_document(known.covering(end), merge) for merge in found])
        elif show is not None:
            display(merge_text(known.covering(end), found[0]))
        else:
            display(merges_text(known.covering(end), found, end))


def _show_refusals(known: KnownHistory, end: Offset, *, json_: bool) -> None:
    found = known.refusals(end)
    if json_:
        emit([refusal_document(known.covering(end), refusal) for refusal in found])
    else:
        display(refusals_text(known.covering(end), found))


def _show_object_merges(known: KnownHistory, end: Offset, *, json_: bool) -> None:
    found = known.object_merges(end)
    if json_:
        emit([object_merge_document(known.covering(end), merge) for merge in found])
    else:
        display(object_merges_text(known.covering(end), found))


def _draw_merge(known: KnownHistory, merge: Merge, out: Path) -> None:
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.adapters.drawing.merge_picture import draw_merge

    draw_merge(known, merge, out)
    say(f"wrote {out}: merge {merge.number}, before and after")


def _numbered(found: list[Merge], number: int) -> Merge:
    """The merge of this number; raises MisuseError naming those there are."""
    for merge in found:
        if merge.number == number:
            return merge
    there = f"there are 1 to {len(found)}" if found else "there are none"
    raise MisuseError(f"no merge number {number}; {there} (see `{advised('merges')}`)")


def why(
    *,
    thing: Annotated[
        str | None,
        typer.Argument(
            metavar="PLACE|OBJECT|RUN:KF",
            help="A place, also an absorbed one: p3, its name or id; an object; the first of two"
            " keyframes.",
        ),
    ] = None,
    other: Annotated[
        str | None, typer.Argument(metavar="RUN:KF", help="The second keyframe, as with --same.")
    ] = None,
    same: Annotated[
        tuple[str, str] | None,
        option(
            "RUN:KF RUN:KF",
            "Since when, and by which merges, two keyframes are in one place.",
            "--same",
        ),
    ] = None,
    crops: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Write the crops of an object that the log keeps there, the best view first, and"
            " name their files.",
        ),
    ] = None,
    at: folded_log.AtOption = "end",
    known_at: folded_log.KnownAtOption = None,
    json_: JsonOption = False,
    past: PastLog,
) -> None:
    """Explain why a place or an object is what it is, event by event.

    Commands that named, joined, kept apart or moved a part of it are listed, too.
    """
    if (thing is None) == (same is None):
        raise MisuseError("give a place, an object, or two keyframes as RUN:KEYFRAME RUN:KEYFRAME")
    pair = (thing, other) if thing is not None and other is not None else same
    with past.known(at, known_at) as (known, end):
        found = _explanation(known, thing, pair, end)
        if crops is not None and found.kind != "object":
            raise MisuseError("--crops writes those of an object")
        written = (
            [] if crops is None else write_views(known.at(end), found.subject, past.log, crops)
        )
    if json_:
        shown = [each._asdict() for each in written]
        emit(found.document() | ({} if crops is None else {"crops": shown}))
        return
    display(explanation_text(found))
    for each in written:
        display(f"  {each.file}: {visible(each.det_id)}, offset {each.offset:,}\n")
    if crops is not None and not written:
        say(f"{past.log} keeps no crop of it; an import with --keep-crops keeps them")


def _explanation(
    known: KnownHistory, thing: str | None, pair: tuple[str, str] | None, end: Offset
) -> Explanation:
    if pair is not None:
        return known.why_same(*pair, end)
    return known.why(thing or "", end)


def diff(
    *,
    first: Annotated[str, typer.Argument(metavar="W1", help=f"From here: {folded_log.W}.")],
    second: Annotated[str, typer.Argument(metavar="W2", help="To here, given as W1.")] = "end",
    known_at: Annotated[
        str | None,
        option(
            "V",
            "Apply only the commands recorded before here, to both maps [default: to each map"
            " those before its end].",
            "--known-at",
        ),
    ] = None,
    json_: JsonOption = False,
    all_: folded_log.AllOption = False,
    past: PastLog,
) -> None:
    """Show what changed from one moment of the map to another.

    Keyframes, places, objects and adjacency, and the commands recorded in between.
    """
    with past.timeline() as timeline:
        reader = timeline.reader
        span = folded_log.point(reader, first), folded_log.point(reader, second)
        known = None if known_at is None else folded_log.point(reader, known_at)
        found = timeline.diff(*span, known_at=known)
    if json_:
        emit(found.document())
    else:
        shorten_by(found.short_ids.text)
        display(difference_text(found, most=None if all_ else folded_log.MOST_LINES))


def changes(
    *,
    since: Annotated[
        str | None,
        option(
            "W|DAY|RUN",
            "From here, a day or a run from its start [default: the start of the last run].",
            "--since",
        ),
    ] = None,
    until: Annotated[
        str, option("W|DAY|RUN", "To here, a day or a run to its end.", "--until")
    ] = "end",
    known_at: Annotated[
        str | None,
        option(
            "V",
            "Apply only the commands recorded before here [default: those before --until].",
            "--known-at",
        ),
    ] = None,
    json_: JsonOption = False,
    all_: folded_log.AllOption = False,
    past: PastLog,
) -> None:
    """Say what changed in the building: what moved, is missing, new or back again.

    One sentence each, only what is sure, the largest first. `diff` shows how two maps differ.
    """
    with past.timeline() as timeline:
        end = timeline.moment(until, is_end=True, note=say)
        start = None if since is None else timeline.moment(since, is_end=False, note=say)
        known = None if known_at is None else folded_log.point(timeline.reader, known_at)
        found = timeline.changes(start, end, known_at=known)
    if json_:
        emit(found.document())
        return
    display(changes_text(found, most=None if all_ else folded_log.MOST_LINES))
    if found.unsure:
        shows = visible(advised("diff", past.log, found.since, found.until))
        say(f"+ {counted(found.unsure, 'change')} not sure; `{shows}` shows them")


def bisect(
    *,
    expression: Annotated[str, typer.Argument(metavar="EXPR", help="The condition.")],
    start: Annotated[str, option("W", f"Search from here: {folded_log.W}.", "--from")] = "0",
    end: Annotated[str, option("W", "Search to here.", "--to")] = "end",
    scan: Annotated[
        bool,
        typer.Option("--scan", help="List every turn to true and to false, not only the first."),
    ] = False,
    known_at: folded_log.KnownAtOption = None,
    json_: JsonOption = False,
    all_: folded_log.AllOption = False,
    past: PastLog,
) -> None:
    with _columns_shown(), past.timeline() as timeline:
        asked = Expression(expression)
        span = folded_log.point(timeline.reader, start), folded_log.point(timeline.reader, end)
        known = timeline.knowing(folded_log.known_point(timeline.reader, known_at, span[1]))
        shorten_by(partial(known.shortened, end=span[1]))
        found = known.bisect(asked, *span, scan=scan)
    if json_:
        emit(found.document())
    else:
        display(search_text(found, most=None if all_ else folded_log.MOST_LINES))


bisect.__doc__ = f"""Find the first event that made a condition over the map true.

EXPR compares numbers and ids, joined by and, or, not and parentheses, for example
"place_count < 3", "same_place('run:12', 'run:90')", "located_in('couch') == 'p2'";
none is no place. It may call:

\b
{indent(functions_help(), "    ")}
"""


@contextlib.contextmanager
def _columns_shown() -> Iterator[None]:
    """Print an expression with a mark where it is wrong, above the error message."""
    try:
        yield
    except ExpressionError as error:
        say(error.pointer)
        raise
