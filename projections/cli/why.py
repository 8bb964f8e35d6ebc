"""`mapfold why`: the life of a place or an object, or why two keyframes are in one place."""

from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from projections.history import Story, Timeline
from projections.history.rendering import story_text

from .options import SetOption, SettingsOption, point
from .terminal import display, emit
from .timeline_options import AtOption, JsonOption, LogArgument, timeline


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
    with timeline(log, settings_file, set_) as opened:
        story = _story(opened, thing, same, point(opened.reader, at))
    if json_:
        emit(story.document())
    else:
        display(story_text(story))


def _story(opened: Timeline, thing: str | None, same: tuple[str, str] | None, end: int) -> Story:
    if same is not None:
        return opened.why_same(*same, end)
    return opened.why(thing or "", end)


def register(app: typer.Typer) -> None:
    """Add `why` to the program."""
    app.command()(why)
