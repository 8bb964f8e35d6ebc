"""Questions to a past map: which settings its log is folded with."""

from pathlib import Path

from eventsrc.cli._shell import say
from eventsrc.errors import MisuseError
from projections.settings import Settings

from ._options import settings_from


def past_settings(log: Path | None, file: Path | None, assignments: list[str] | None) -> Settings:
    """The settings to fold ``log`` with.

    Raises MisuseError when there are settings but no log: the live map keeps its own.
    """
    if log is None and (file is not None or assignments):
        raise MisuseError(
            "--set and --settings are for folding a log, and the live map keeps the settings it was"
            " made with; give --log LOG too, or run mapfold replay with them"
        )
    return settings_from(file, assignments)


def say_defaults(settings: Settings) -> None:
    """Once folded, tell people that the settings were not the live map's but the default ones."""
    if settings == Settings():
        say("folded with the default settings; a live map made with others needs its --set here")
