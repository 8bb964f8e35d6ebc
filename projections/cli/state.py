"""`mapfold state`: the map folded to a point in the log."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from projections.model.advice import places_advice
from projections.model.digest import map_digest
from projections.model.export import state_document, state_text
from projections.model.fold import fold_log_cached
from projections.model.log_commands import read_corrections

from .options import (
    JsonOption,
    KnownAtOption,
    SetOption,
    SettingsOption,
    W,
    known_point,
    point,
    settings_from,
)
from .terminal import display, emit, say


def state(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")],
    at: Annotated[
        str,
        typer.Option("--at", metavar="W", help=f"Fold to here: {W}."),
    ] = "end",
    known_at: KnownAtOption = None,
    json_: JsonOption = False,
    digest: Annotated[bool, typer.Option("--digest", help="Print only the digest.")] = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """The map folded to a point in the log.

    Counts, settings, digest, and each place with its size and neighbours; --json prints all.
    """
    if json_ and digest:
        raise MisuseError("--json and --digest together: --json prints the digest too")
    settings_from(settings_file, set_)  # a bad value is an error before the log is opened
    with LogReader(log) as reader:
        end = point(reader, at)
        known = known_point(reader, known_at, end)
        corrections = read_corrections(reader, known)
        settings = settings_from(settings_file, set_, corrections)
        _, view = fold_log_cached(reader, settings, end, note=say, corrections=corrections)
    hexdigits = map_digest(view)
    if json_:
        emit(state_document(view, hexdigits, known))
    elif digest:
        display(f"{hexdigits}\n")
    else:
        display(state_text(view, hexdigits, known))
    advice = None if digest else places_advice(view.counts(), settings)
    if advice is not None:
        say(advice)


def register(app: typer.Typer) -> None:
    """Add `state` to the program."""
    app.command()(state)
