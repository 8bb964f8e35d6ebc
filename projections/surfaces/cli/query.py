"""``mapfold query``: similar objects, where an object is, what a place holds, paths."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.errors import MisuseError
from eventsrc.log import LogReader
from projections.map.own_events import read_corrections
from projections.map.phrases import seen_times
from projections.postgres.connection import connect
from projections.postgres.queries.candidate_search import CandidateReader, prepare_graph
from projections.postgres.queries.map_queries import (
    FoldedMap,
    LiveMap,
    MapSource,
    objects_of,
    path_between,
    places_holding,
    similar_objects,
    where_is,
)
from projections.store.history_recorder import map_after

from .folded_log import FoldSettings, W, point, say_defaults
from .options import Databases, DbOption, JsonOption, QuestionArgument, question_from
from .terminal import display, emit, say

query = typer.Typer(
    no_args_is_help=True, help="Ask the map: similar, where, contents, holding, path."
)

AllOption = Annotated[bool, typer.Option("--all", help="Print objects seen once, too.")]
PlaceArgument = Annotated[
    str, typer.Argument(metavar="PLACE", help="A place: p3, a name, a type of room.")
]


@dataclass(frozen=True, kw_only=True)
class PastMap:
    """The log to ask instead of the live map, and the point up to which it is folded."""

    at: Annotated[
        str | None,
        typer.Option("--at", metavar="W", help=f"Ask the map as it was: {W} of --log."),
    ] = None
    log: Annotated[
        Path | None,
        typer.Option("--log", metavar="LOG", help="Ask this log, folded, instead of the live map."),
    ] = None


@dataclass(frozen=True, kw_only=True)
class AskedMap(FoldSettings, PastMap):
    """The map that a question is for."""

    db: DbOption = None

    @contextlib.contextmanager
    def source(self) -> Iterator[MapSource]:
        """The live graph, or the log folded to a point with its settings and corrections."""
        if self.log is not None:
            with LogReader(self.log) as reader:
                end = point(reader, self.at or "end")
                corrections = read_corrections(reader, end)
                settings = self.of_past_map(self.log, corrections)
                view = map_after(reader, settings, end, corrections=corrections, note=say)
            say_defaults(settings)
            yield FoldedMap(view)
            return
        self.of_past_map(None)  # refuses settings
        if self.at is not None:
            raise MisuseError("--at asks a past map, which only the log knows; give --log LOG too")
        with (
            Databases(db=self.db).opened() as targets,
            connect(targets.graph_url, application="mapfold query", autocommit=True) as connection,
        ):
            prepare_graph(connection)
            yield LiveMap(connection)


@query.command()
def similar(
    *,
    question: QuestionArgument,
    top: Annotated[
        int, typer.Option("--top", metavar="N", min=1, max=64, help="Objects to list.")
    ] = 10,
    databases: Databases,
    json_: JsonOption = False,
) -> None:
    """List the objects that look most like the crops of QUERY."""
    crops = question_from(question).crops
    with databases.opened() as targets, CandidateReader(targets) as reader:
        found = similar_objects(crops, reader.candidates(crops), top)
    _print(found, json_)


@query.command()
def where(
    *,
    wanted: Annotated[
        str,
        typer.Argument(
            metavar="WHAT",
            help="An object's id or its first six characters, a class, a place, or a kind of room.",
        ),
    ],
    asked: AskedMap,
    json_: JsonOption = False,
) -> None:
    """Find an object, or the places that are rooms of a kind, such as kitchens.

    What kind of room a place is follows from the objects in it, or from its name.
    """
    with asked.source() as source:
        _print(where_is(source, wanted), json_)


@query.command()
def contents(
    *,
    place: PlaceArgument,
    all_: AllOption = False,
    asked: AskedMap,
    json_: JsonOption = False,
) -> None:
    """List the objects located in a place.

    Those seen once, from one spot at one time, are only counted; --json has all.
    """
    with asked.source() as source:
        found = objects_of(source, place)
    once = 0 if json_ or all_ else sum(not thing["confirmed"] for thing in found)
    if once:
        found = [thing for thing in found if thing["confirmed"]]
    if found or not once:
        _print(found, json_)
    if once:
        say(f"+ {once:,} seen once; --all prints them")


@query.command()
def holding(
    *,
    class_name: Annotated[str, typer.Argument(metavar="CLASS", help="A class, such as cup.")],
    start: Annotated[str, typer.Option("--from", metavar="PLACE", help="The place to start from.")],
    hops: Annotated[int, typer.Option("--hops", metavar="N", min=0, help="Most steps.")] = 2,
    all_: AllOption = False,
    asked: AskedMap,
    json_: JsonOption = False,
) -> None:
    """List the places near a place that hold an object of a class.

    Near is at most --hops steps away; a step is from a place to an adjacent one. Places where such
    objects were only seen once are left out, unless --all or --json is given.
    """
    with asked.source() as source:
        found = places_holding(source, class_name, start, hops)
    _print([place for place in found if json_ or all_ or place["confirmed"]], json_)


@query.command()
def path(
    *,
    start: PlaceArgument,
    goal: Annotated[str, typer.Argument(metavar="GOAL", help="The other place.")],
    asked: AskedMap,
    json_: JsonOption = False,
) -> None:
    """List the places on the way from one place to another."""
    with asked.source() as source:
        _print(path_between(source, start, goal), json_)


def _print(found: Any, as_json: bool) -> None:
    rows = [_with_iso_times(row) for row in (found if isinstance(found, list) else [found])]
    if as_json:
        emit(rows if isinstance(found, list) else rows[0])
    else:
        display("".join(f"{_format(row)}\n" for row in rows) or "nothing found")


def _with_iso_times(row: dict[str, Any]) -> dict[str, Any]:
    if "first_seen" not in row:
        return row
    return {**row, **seen_times(row["first_seen"], row["last_seen"])}


def _format(row: dict[str, Any]) -> str:
    shown = {name: row.get(f"{name}_iso", value) for name, value in row.items()}
    return "  ".join(
        f"{name} {value:.3f}" if isinstance(value, float) else f"{name} {value}"
        for name, value in shown.items()
        if value is not None and not name.endswith("_iso")
    )
