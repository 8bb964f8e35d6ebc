"""`mapfold bisect`: the event that made a condition over the map true."""

import contextlib
from collections.abc import Iterator
from textwrap import indent
from typing import Annotated

import typer

from projections.history import Expression, ExpressionError
from projections.history.condition_functions import functions_help
from projections.history.rendering import search_text

from .options import SetOption, SettingsOption, W, point
from .terminal import display, emit, say
from .timeline_options import MOST_LINES, AllOption, JsonOption, LogArgument, timeline

_HELP = f"""The first event that made a condition over the map true.

EXPR compares numbers and ids, joined by and, or, not and parentheses, for example
"place_count < 3", "same_place('run:12', 'run:90')", "located_in('obj-…') == 'run_p2'";
none is no place. It may ask:

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
    with _pointing(), timeline(log, settings_file, set_) as opened:
        asked = Expression(expression)
        span = point(opened.reader, start), point(opened.reader, end)
        found = opened.bisect(asked, *span, scan=scan)
    if json_:
        emit(found.document())
    else:
        display(search_text(found, most=None if all_ else MOST_LINES))


@contextlib.contextmanager
def _pointing() -> Iterator[None]:
    """Show where an expression is wrong, above the one line that says why."""
    try:
        yield
    except ExpressionError as error:
        say(error.pointer)
        raise


def register(app: typer.Typer) -> None:
    """Add `bisect` to the program."""
    app.command(help=_HELP)(bisect)
