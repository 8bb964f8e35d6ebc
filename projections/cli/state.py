"""`mapfold state`: the map folded to a point in the log."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from projections.model.digest import map_digest
from projections.model.export import state_document, state_text
from projections.model.fold import fold_log_cached

from .options import JsonOption, SetOption, SettingsOption, W, point, settings_from
from .terminal import display, emit, say


def state(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")],
    at: Annotated[
        str,
        typer.Option("--at", metavar="W", help=f"Fold to here: {W}."),
    ] = "end",
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
    settings = settings_from(settings_file, set_)
    with LogReader(log) as reader:
        _, view = fold_log_cached(reader, settings, point(reader, at), note=say)
    hexdigits = map_digest(view)
    if json_:
        emit(state_document(view, hexdigits))
    elif digest:
        display(f"{hexdigits}\n")
    else:
        display(state_text(view, hexdigits))


def register(app: typer.Typer) -> None:
    """Add `state` to the program."""
    app.command()(state)
