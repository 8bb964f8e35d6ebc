"""Output of commands: data on stdout, messages and progress bars on stderr, and the exit code 3.

Everything printed goes through `eventsrc.base.text`, which escapes control characters: keys, names
and reasons come from the network.
"""

import contextlib
import json
import sys
from collections.abc import Callable, Iterable
from typing import Any

import typer
from rich.console import Console

from eventsrc.base.text import visible, visible_json, visible_lines

EXIT_FAILED = 1
EXIT_FINDINGS = 3


class _People(Console):
    def __init__(self) -> None:
        """Markup is off, since ids and reasons may hold any text."""
        super().__init__(stderr=True, highlight=False, soft_wrap=True, markup=False)

    @property
    def is_terminal(self) -> bool:
        """Whether the stream is a terminal. FORCE_COLOR and TTY_COMPATIBLE, by which rich takes a
        pipe or a file for a terminal, must not put progress bars into it."""
        try:
            return self.file.isatty()
        except ValueError:  # closed
            return False


people = _People()
"""Stderr."""


class OutputLost(Exception):
    """A write to stdout failed; the text is the reason."""


def say(message: str) -> None:
    """Print a message of one or several lines to stderr, and before it what stdout still buffers,
    so that both are in order where they go to one pipe.

    What stdout does not take stays in its buffer: the command goes on, and at its end
    `program.run_app` writes it again and reports the failure.
    """
    with contextlib.suppress(BrokenPipeError, OutputLost):
        sys.stdout.flush()
    people.print(visible_lines(message))


def display(text: str) -> None:
    """Print text to stdout, with a newline at its end if it has none."""
    sys.stdout.write(visible_lines(text))
    if text and not text.endswith("\n"):
        sys.stdout.write("\n")


def say_metrics(address: tuple[str, int], port: int) -> None:
    """Print where the metrics of ``--metrics`` are served, and warn when others can read them."""
    from eventsrc.record.transport.config import is_loopback

    say(f"metrics on http://{address[0]}:{port}/metrics")
    if not is_loopback(address[0]):
        say(
            f"warning: --metrics {address[0]}:{address[1]}: everybody who can reach it reads these"
            " numbers; keep it in a network of your own"
        )


def emit(document: Any) -> None:
    """Print one JSON document to stdout."""
    encoder = json.JSONEncoder(ensure_ascii=False, allow_nan=False, indent=2)
    for part in encoder.iterencode(document):
        sys.stdout.write(visible_json(part))
    sys.stdout.write("\n")


def emit_lines(documents: Iterable[Any]) -> None:
    """Print JSON lines to stdout, each as soon as it comes."""
    for document in documents:
        text = json.dumps(document, ensure_ascii=False, allow_nan=False)
        sys.stdout.write(visible_json(text) + "\n")


def finish(*, findings: bool) -> None:
    """End the command with exit 3 when something was lost or found, else let it return 0."""
    if findings:
        raise typer.Exit(EXIT_FINDINGS)


class _Listeners:
    """The functions that `reading_bar` has registered."""

    output: Callable[[], None] | None = None
    own_bar: Callable[[int], None] | None = None


def on_output(listener: Callable[[], None] | None) -> None:
    """Register a function that is called before data is written to stdout."""
    _Listeners.output = listener


def on_own_bar(listener: Callable[[int], None] | None) -> None:
    """Register a function that is called with 1 before a command shows a bar of its own, and with
    -1 after it."""
    _Listeners.own_bar = listener


def output_begins() -> None:
    """Call the registered function; for code that writes to stdout by itself."""
    if _Listeners.output is not None:
        _Listeners.output()


def _own_bar(opened: int) -> None:
    if _Listeners.own_bar is not None:
        _Listeners.own_bar(opened)


class Bar:
    """A progress bar with rate and time left; prints nothing when stderr is not a terminal. Unless
    it is ``announced``, it is that of `reading_bar`, which gives way to all others."""

    def __init__(self, *, announced: bool = True) -> None:
        from rich import progress  # here: importing it takes a tenth of a short command

        self._announced = announced
        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("{task.fields[rate]}"),
            progress.TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )
        self._stage = ""
        self._task = self._progress.add_task("", total=None, rate="")

    def __enter__(self) -> "Bar":
        if self._announced:
            _own_bar(1)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        if self._announced:
            _own_bar(-1)

    def show(self, stage: str, done: int, total: int, unit: str = "events") -> None:
        """Show the current stage and how much of it is done, ``done`` of ``total`` events or other
        units. A total of 0 is unknown: then only activity is shown."""
        if stage != self._stage:
            self._stage = stage
            self._progress.reset(self._task)
        speed = self._progress.tasks[0].speed
        rate = f"{speed:,.0f} {unit}/s" if speed else ""
        self._progress.update(
            self._task, description=stage, completed=done, total=total or None, rate=rate
        )

    def show_fold(self, done: int, total: int) -> None:
        """Progress of a command that only folds: the bar is removed when all events are folded."""
        self.show("folding", done, total)
        if done >= total:
            self.stop()

    def stop(self) -> None:
        """Remove the bar. May be called twice."""
        self._progress.stop()


class FileBars:
    """A progress bar for each file that is read, by its bytes; nothing without a terminal."""

    def __init__(self) -> None:
        from rich import progress

        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TransferSpeedColumn(),
            progress.TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )
        self._tasks: dict[int, progress.TaskID] = {}

    def __enter__(self) -> "FileBars":
        _own_bar(1)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        _own_bar(-1)

    def show(self, file: int, name: str, done: int, size: int | None) -> None:
        """Show that ``done`` bytes of a file are read; ``file`` is a number of its own."""
        if file not in self._tasks:
            self._tasks[file] = self._progress.add_task(visible(name), total=size)
        self._progress.update(self._tasks[file], completed=done)
