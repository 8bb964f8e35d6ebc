"""What every command shares: data on stdout, people on stderr, findings as an exit code.

Whatever is printed goes through here, and so through `eventsrc.text`: keys, names and reasons
come from the network.

How far a long command is, for people at a terminal.
"""

import json
import sys
from collections.abc import Iterable
from types import TracebackType
from typing import Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from eventsrc.text import visible_json, visible_lines
from eventsrc.transport.config import is_loopback

EXIT_FAILED = 1
EXIT_FINDINGS = 3


people = Console(stderr=True, highlight=False, soft_wrap=True, markup=False)
"""Plain text: ids and reasons may hold anything, so markup is off."""


def say(message: str) -> None:
    """One line for people, or lines that were laid out."""
    people.print(visible_lines(message))


def display(text: str) -> None:
    """Lines on stdout for people; an end is added to the last one if it has none."""
    sys.stdout.write(visible_lines(text))
    if text and not text.endswith("\n"):
        sys.stdout.write("\n")


def say_metrics(address: tuple[str, int], port: int) -> None:
    """Where the numbers of ``--metrics`` are, and who can read them."""
    say(f"metrics on http://{address[0]}:{port}/metrics")
    if not is_loopback(address[0]):
        say(
            f"warning: --metrics {address[0]}:{address[1]}: everybody who can reach it reads these"
            " numbers; keep it in a network of your own"
        )


def emit(document: Any) -> None:
    """One JSON document on stdout."""
    encoder = json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=2)
    for part in encoder.iterencode(document):
        sys.stdout.write(visible_json(part))
    sys.stdout.write("\n")


def emit_lines(documents: Iterable[Any]) -> None:
    """JSON lines on stdout, each as soon as it is there."""
    for document in documents:
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
        sys.stdout.write(visible_json(text) + "\n")


def finish(*, findings: bool) -> None:
    """End the command with exit 3 when something was lost or found, else let it return 0."""
    if findings:
        raise typer.Exit(EXIT_FINDINGS)


class Bar:
    """A progress bar with rate and time left on a terminal, silence elsewhere."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )
        self._task = self._progress.add_task("folding", total=None, rate="")

    def __enter__(self) -> "Bar":
        self._progress.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.stop()

    def show(self, stage: str, done: int, total: int) -> None:
        """Show that ``done`` of ``total`` events are through, and what is going on."""
        speed = self._progress.tasks[0].speed
        rate = f"{speed:,.0f} events/s" if speed else ""
        self._progress.update(self._task, description=stage, completed=done, total=total, rate=rate)

    def stop(self) -> None:
        """Take the bar away. May be called twice."""
        self._progress.stop()
