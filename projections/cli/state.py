"""`mapfold state`: the map folded to a point in the log."""

from pathlib import Path
from typing import Annotated

import typer

from eventsrc.cli._shell import display, emit, say
from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from projections.cli._options import SetOption, SettingsOption, settings_from
from projections.cli._point import W, point
from projections.digest import map_digest
from projections.folding import fold_log_cached
from projections.state_json import state_document
from projections.state_text import state_text


def state(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")],
    at: Annotated[
        str,
        typer.Option("--at", metavar="W", help=f"Fold to here: {W}."),
    ] = "end",
    json_: Annotated[bool, typer.Option("--json", help="The whole map as JSON on stdout.")] = False,
    digest: Annotated[bool, typer.Option("--digest", help="Print only the digest.")] = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """The map folded to a point in the log.

    Counts, settings, digest, and each place with its size and its neighbours; --json has it all.
    """
    if json_ and digest:
        raise MisuseError("--json and --digest together: --json holds the digest already")
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
