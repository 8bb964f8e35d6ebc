"""Output of commands: data on stdout, messages and progress bars on stderr, and the exit code 3.

Everything printed goes through `eventsrc.base.text`, which escapes control characters: keys, names
and reasons come from the network. Ids in text are printed short where the command has said by which
map (`shorten_by`); JSON keeps them whole.
"""

import contextlib
import json
import os
import stat
import sys
import threading
from collections.abc import Iterable
from typing import Any, Self

import typer
from rich.console import Console

from eventsrc.base.progress import send_progress_to
from eventsrc.base.text import shortened, visible, visible_json, visible_lines

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
    people.print(visible_lines(shortened(message)))


def display(text: str) -> None:
    """Print text to stdout, with a newline at its end if it has none."""
    sys.stdout.write(visible_lines(shortened(text)))
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


class _Bars:
    """Progress on stderr while inside it; prints nothing when stderr is not a terminal.

    `ReadingBar` gives way to bars of a command, and gives ``own=False`` to its own.
    """

    def __init__(self, *columns: Any, own: bool = True) -> None:
        from rich import progress  # here: importing it takes a tenth of a short command

        self._own = own
        self._progress = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            *(getattr(progress, each)() if isinstance(each, str) else each for each in columns),
            progress.TimeRemainingColumn(),
            console=people,
            transient=True,
            disable=not people.is_terminal,
        )

    def __enter__(self) -> Self:
        self._displace_reading(1)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
        self._displace_reading(-1)

    def stop(self) -> None:
        """Remove the bar. May be called twice."""
        self._progress.stop()

    def _displace_reading(self, opened: int) -> None:
        for bar in _reading if self._own else ():
            bar.give_way(opened)


class Bar(_Bars):
    """A progress bar with rate and time left."""

    def __init__(self, *, own: bool = True) -> None:
        from rich.progress import TextColumn

        super().__init__("MofNCompleteColumn", TextColumn("{task.fields[rate]}"), own=own)
        self._stage = ""
        self._task = self._progress.add_task("", total=None, rate="")

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


class FileBars(_Bars):
    """A progress bar for each file that is read, by its bytes."""

    def __init__(self) -> None:
        super().__init__("TaskProgressColumn", "TransferSpeedColumn")
        self._tasks: dict[int, Any] = {}

    def show(self, file: int, name: str, done: int, size: int | None) -> None:
        """Show that ``done`` bytes of a file are read; ``file`` is a number of its own."""
        if file not in self._tasks:
            self._tasks[file] = self._progress.add_task(visible(name), total=size)
        self._progress.update(self._tasks[file], completed=done)


class ReadingBar:
    """The bar of every command: shows the reports of `base.progress` once work takes a second.

    Commands need no code for it. It is hidden while a command shows a bar of its own, and ends once
    data is written to stdout, unless that is a file, because both would be mixed on a terminal or
    in a pager. Work in other threads, as of a server, is not shown.
    """

    def __init__(self, delay_s: float = 1.0) -> None:
        self._delay_s = delay_s
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._bar: Bar | None = None
        self._latest = ("", 0, 0, "")
        self._others = 0
        """Bars of the command itself."""
        self._over = not people.is_terminal

    def __enter__(self) -> "ReadingBar":
        if not self._over:
            send_progress_to(self.show)
            _reading.append(self)
        return self

    def __exit__(self, *_: object) -> None:
        send_progress_to(None)
        _reading.clear()
        self._stop()

    def show(self, stage: str, done: int, total: int, unit: str) -> None:
        """Show the stage from ``delay_s`` after its first report until its last."""
        if self._over or self._others or threading.current_thread() is not threading.main_thread():
            return
        if 0 < total <= done:
            self._stop()
            return
        with self._lock:
            self._latest = (stage, done, total, unit)
            if self._bar is not None:
                self._bar.show(*self._latest)
            elif self._timer is None:
                self._timer = threading.Timer(self._delay_s, self._start)
                self._timer.daemon = True
                self._timer.start()

    def _start(self) -> None:
        with self._lock:
            if self._timer is None:  # stopped meanwhile
                return
            self._bar = Bar(own=False)
            self._bar.show(*self._latest)
            self._bar.__enter__()

    def _stop(self) -> None:
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            bar, self._timer, self._bar = self._bar, None, None
        if bar is not None:
            bar.stop()

    def give_way(self, opened: int) -> None:
        """Hide it: a command shows ``opened`` more bars of its own."""
        self._others += opened
        self._stop()

    def end_before_output(self) -> None:
        """End it, unless stdout is a file: data is written to it."""
        if not self._over and not _is_file(1):
            self._over = True
            self._stop()


_reading: list[ReadingBar] = []
"""That of the command that runs."""


def output_begins() -> None:
    """To be called before data is written to stdout."""
    for bar in _reading:
        bar.end_before_output()


def _is_file(number: int) -> bool:
    try:
        return stat.S_ISREG(os.fstat(number).st_mode)
    except OSError:
        return False
