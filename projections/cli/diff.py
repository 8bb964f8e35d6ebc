"""`mapfold diff`: what lies between two moments of a map."""

from typing import Annotated

import typer

from projections.history.rendering import difference_text

from .options import SetOption, SettingsOption, W, point
from .terminal import display, emit
from .timeline_options import MOST_LINES, AllOption, JsonOption, LogArgument, timeline


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
    with timeline(log, settings_file, set_) as opened:
        found = opened.diff(point(opened.reader, first), point(opened.reader, second))
    if json_:
        emit(found.document())
    else:
        display(difference_text(found, most=None if all_ else MOST_LINES))


def register(app: typer.Typer) -> None:
    """Add `diff` to the program."""
    app.command()(diff)
