"""Options that several commands share: which databases, which settings. Declared once.

A point of a log on the command line: W means the same, and warns the same, in every command.

A picture's name, looked at before anything is folded for it.

Questions to a past map: which settings its log is folded with.
"""

import contextlib
import json
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from eventsrc.errors import MisuseError
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from projections.database.connection import Targets, open_targets
from projections.errors import SettingsError
from projections.settings import Settings

from .terminal import say

DbOption = Annotated[
    str | None,
    typer.Option(
        "--db",
        metavar="URL",
        help="PostgreSQL with Apache AGE for the graph [env MAPFOLD_DB; default: embedded server].",
    ),
]
VectorDbOption = Annotated[
    str | None,
    typer.Option(
        "--vector-db",
        metavar="URL",
        help="PostgreSQL with pgvector for the embeddings [env MAPFOLD_VECTOR_DB; default: --db].",
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="NAME=VALUE", help="Change one setting of the fold, such as eps_m=1.0."
    ),
]
SettingsOption = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="JSON object of settings; --set goes on top."),
]


def settings_from(file: Path | None, assignments: list[str] | None) -> Settings:
    """The settings a command runs with. Raises SettingsError naming file and field."""
    settings = Settings() if file is None else _settings_of_file(file)
    return settings.with_assignments(assignments or ())


def _settings_of_file(file: Path) -> Settings:
    try:
        return Settings.from_document(json.loads(file.read_text("utf-8")))
    except OSError as error:
        raise SettingsError(f"--settings {file}: {error.strerror}") from None
    except SettingsError as error:
        raise SettingsError(f"--settings {file}: {error}") from None
    except (ValueError, RecursionError) as error:
        raise SettingsError(f"--settings {file}: not JSON: {error}") from None


@contextlib.contextmanager
def databases(db: str | None, vector_db: str | None) -> Iterator[Targets]:
    """The databases a command uses. Also after SIGTERM no embedded server is left behind."""
    with sigterm_unwinds(), open_targets(db, vector_db) as targets:
        yield targets


@contextlib.contextmanager
def sigterm_unwinds() -> Iterator[None]:
    """SIGTERM ends the command through its ``finally`` blocks, as Ctrl-C does."""

    def leave(signum: int, _frame: FrameType | None) -> None:
        sys.exit(128 + signum)

    if signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:  # the command has its own way
        yield
        return
    signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


W = "number of events, ISO time, RUN:KEYFRAME (inclusive) or end"
"""What W may be, for help texts."""


def point(reader: LogReader, text: str) -> int:
    """The number of events that W means in this log; people are told when stamps run backwards."""
    return resolve(reader, text, note=say)


def check_picture(out: Path | None) -> None:
    """Raises MisuseError when ``out`` is no picture's name; None is no picture."""
    if out is None:
        return
    # Here and not above: matplotlib takes longer to import than most commands take to run.
    from projections.drawing.canvas import check_name

    check_name(out)


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
