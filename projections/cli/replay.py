"""``mapfold replay``: rebuild the databases from a log."""

from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from eventsrc.cli._shell import emit, say
from eventsrc.log import LogReader
from eventsrc.words import counted
from projections.runner import RebuildReport, rebuild
from projections.settings import Settings
from projections.sink import SinkName
from projections.sinks.loader import LoaderName

from ._bar import Bar
from ._left_out import left_out
from ._options import (
    DbOption,
    SetOption,
    SettingsOption,
    VectorDbOption,
    databases,
    settings_from,
)
from ._point import W, point


class Sinks(StrEnum):
    """What ``--only`` takes."""

    graph = "graph"
    vectors = "vectors"


class Loaders(StrEnum):
    """What ``--loader`` takes."""

    copy = "copy"
    insert = "insert"


LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="The log's directory.")]
OnlyOption = Annotated[
    Sinks | None, typer.Option("--only", help="Write only the graph or only the vectors.")
]
LoaderOption = Annotated[
    Loaders,
    typer.Option("--loader", help="How rows are sent; insert where COPY is not allowed."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]


def register(app: typer.Typer) -> None:
    """Add ``replay`` to ``app``."""
    app.command()(replay)


def only_of(only: Sinks | None) -> SinkName | None:
    """The sink's name, None for both."""
    return None if only is None else only.value


def loader_of(loader: Loaders) -> LoaderName:
    """The loader's name."""
    return loader.value


def replay(
    log: LogArgument,
    until: Annotated[str, typer.Option("--until", metavar="W", help=f"Fold to here: {W}.")] = "end",
    only: OnlyOption = None,
    db: DbOption = None,
    vector_db: VectorDbOption = None,
    assignments: SetOption = None,
    settings_file: SettingsOption = None,
    loader: LoaderOption = Loaders.copy,
    no_hnsw: Annotated[
        bool, typer.Option("--no-hnsw", help="Do not index a large table for vector search.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Rebuild the databases from LOG. Readers see the old map until the new one is whole."""
    settings = settings_from(settings_file, assignments)
    with LogReader(log) as reader:
        end = point(reader, until)
    with databases(db, vector_db) as targets, Bar() as bar:
        report = rebuild(
            log,
            targets,
            settings,
            until=end,
            only=only_of(only),
            loader=loader_of(loader),
            hnsw=not no_hnsw,
            progress=lambda at: bar.show(at.stage, at.done, at.total),
        )
    if as_json:
        emit(asdict(report))
    else:
        _tell(log, settings, report)


def _tell(log: Path, settings: Settings, report: RebuildReport) -> None:
    rows = sum(report.rows.values())
    rate = report.events / report.total_s if report.total_s else 0.0
    say(
        f"{log}: {counted(report.events, 'event')}, {counted(rows, 'row')}"
        f" in {report.total_s:.2f} s ({rate:,.0f} events/s); digest {report.digest[:16]}"
    )
    counts = report.counts
    words = ("run", "keyframe", "observation", "object", "place")
    say(", ".join(counted(counts[f"{word}s"], word) for word in words))
    if report.hnsw is not None:
        say(f"vector search: {report.hnsw.reason}")
    missing = left_out(log, settings, report)
    if missing is not None:
        say(missing)
