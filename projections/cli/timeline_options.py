"""What the time travel commands share: the LOG and --at arguments, and a timeline with progress."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

from projections.history import Timeline
from projections.settings import Settings

from .options import W, settings_from
from .terminal import people

LogArgument = Annotated[Path, typer.Argument(metavar="LOG", help="The log's folder.")]
AtOption = Annotated[
    str,
    typer.Option(
        "--at",
        metavar="W",
        help=f"Look from here: {W}.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")]
AllOption = Annotated[bool, typer.Option("--all", help="Name every thing, however many.")]

MOST_LINES = 5
"""Things of a kind that a text answer names without --all."""


@contextlib.contextmanager
def timeline(log: Path, settings_file: Path | None, sets: list[str] | None) -> Iterator[Timeline]:
    """The log's timeline under the settings of the command line, with a bar on a terminal."""
    settings: Settings = settings_from(settings_file, sets)
    with FoldBar() as bar, Timeline(log, settings, progress=bar) as opened:
        yield opened


class _Rate(ProgressColumn):
    """Events per second."""

    def render(self, task: Task) -> Text:
        return Text("" if task.speed is None else f"{task.speed:,.0f} events/s")


class FoldBar:
    """A bar for people while events are folded; nothing where nobody watches."""

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("folding"),
            BarColumn(),
            MofNCompleteColumn(),
            _Rate(),
            TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )
        self._task = self._bar.add_task("folding", total=None)

    def __enter__(self) -> "FoldBar":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def __call__(self, done: int, total: int) -> None:
        self._bar.update(self._task, completed=done, total=total)
        if done >= total:
            self._bar.stop()
