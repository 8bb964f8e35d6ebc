"""`mapfold edits`: the commands in a log."""

import functools
from typing import Annotated

import typer

from eventsrc.log import LogReader
from projections.edit.current import CurrentMap
from projections.edit.effect import effects_of
from projections.edit.listing import edits_document, edits_text

from .options import JsonOption, LogArgument, SetOption, SettingsOption, settings_from
from .terminal import display, emit, say


def edits(
    log: LogArgument,
    effects: Annotated[
        bool,
        typer.Option(
            "--effects", help="Work out the effects that are not known yet: two folds for each."
        ),
    ] = False,
    json_: JsonOption = False,
    set_: SetOption = None,
    settings_file: SettingsOption = None,
) -> None:
    """The commands in a log: who gave which when and why, what it changed, and what is undone.

    An effect counts the places, objects and keyframes that were changed in the map of the events
    before the command. `mapfold edit` keeps that of its command beside the log.
    """
    settings_of = functools.partial(settings_from, settings_file, set_)
    with LogReader(log) as reader:
        current = CurrentMap(reader, settings_of, note=say)
        found = effects_of(current, known_only=not effects)
        times = {event.offset: event.logged_ns for event in current.command_events()}
    if json_:
        emit(edits_document(found, times))
    else:
        display(edits_text(found, times))


def register(app: typer.Typer) -> None:
    """Add `edits` to the program."""
    app.command()(edits)
