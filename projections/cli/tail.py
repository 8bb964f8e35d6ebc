"""``mapfold tail``: keep the databases at the end of a log."""

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer

from eventsrc.envelope import Offset
from eventsrc.log import LogReader
from eventsrc.text import counted
from eventsrc.transport.config import parse_address
from projections.database import TailProgress, TailReport, tail

from .options import (
    DbOption,
    JsonOption,
    LogArgument,
    SetOption,
    SettingsOption,
    VectorDbOption,
    databases,
    settings_of,
)
from .replay import LoaderOption, Loaders, OnlyOption, loader_of, only_of
from .terminal import Bar, emit, finish, say, say_metrics


def register(app: typer.Typer) -> None:
    """Add ``tail`` to ``app``."""
    app.command(name="tail")(tail_command)


def tail_command(
    log: LogArgument,
    once: Annotated[bool, typer.Option("--once", help="Stop when caught up.")] = False,
    only: OnlyOption = None,
    db: DbOption = None,
    vector_db: VectorDbOption = None,
    assignments: SetOption = None,
    settings_file: SettingsOption = None,
    loader: LoaderOption = Loaders.copy,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="PORT", help="Serve Prometheus metrics; PORT or HOST:PORT."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Keep the databases live while LOG grows; what cannot be folded is parked and listed."""
    settings = settings_of(settings_file, assignments)
    address = None if metrics is None else parse_address(metrics, "--metrics")
    progress = TailProgress()
    with LogReader(log) as reader:
        end = reader.next_offset
    with (
        _stopped_by_signals() as stop,
        databases(db, vector_db) as targets,
        _metrics(address, progress, log),
        Bar() as bar,
    ):
        report = tail(
            log,
            targets,
            settings,
            once=once,
            only=only_of(only),
            loader=loader_of(loader),
            stop=stop,
            progress=progress,
            on_fold=_CatchUpBar(log, end, bar, once).show,
            on_refold=_RefoldNote().tell,
            on_trouble=lambda what: _report_failure(what, progress),
            note=say,
        )
    if as_json:
        emit(_document(report))
    else:
        _print(report)
    finish(findings=bool(report.parked))


@contextlib.contextmanager
def _metrics(address: tuple[str, int] | None, progress: TailProgress, log: Path) -> Iterator[None]:
    if address is None:
        yield
        return
    # Imported only when used.
    from projections.database.tail_metrics import serving_tail_metrics

    with serving_tail_metrics(address, progress, log) as port:
        say_metrics(address, port)
        yield


def _report_failure(what: str, progress: TailProgress) -> None:
    progress.count_failure()
    say(f"mapfold: {what}; trying again")


class _CatchUpBar:
    """A bar until the tail has the events that were in the log at its start, then one line."""

    def __init__(self, log: Path, end: Offset, bar: Bar, once: bool) -> None:
        self._log, self._end, self._bar = log, end, bar
        self._once, self._done = once, False

    def show(self, folded: int) -> None:
        """Update the bar: ``folded`` events are written."""
        if self._done:
            return
        self._bar.show("catching up", folded, self._end)
        if folded >= self._end:
            self._done = True
            self._bar.stop()
            if not self._once:
                say(f"following {self._log} from offset {folded:,} on; Ctrl-C ends it")


class _RefoldNote:
    """One line for each refold that begins."""

    def __init__(self) -> None:
        self._done = 0

    def tell(self, done: int, total: int) -> None:
        """``done`` of ``total`` events are refolded."""
        if self._done == 0 or done < self._done:
            say(
                f"a command changes earlier events: folding {counted(total, 'event')} again;"
                " readers keep the old map until the new one is whole"
            )
        self._done = done


def _document(report: TailReport) -> dict[str, Any]:
    """The report as JSON, with ``refolds`` only where there were some."""
    document = asdict(report)
    if not report.refolds:
        del document["refolds"]
    return document


def _print(report: TailReport) -> None:
    done = []
    if report.refolds:
        done.append(f"refolded {counted(report.refolds, 'time')} because of commands")
    if report.batches or not report.refolds:
        batches = "batch" if report.batches == 1 else "batches"
        done.append(f"{counted(report.events, 'event')} written in {report.batches:,} {batches}")
    say(f"{'; '.join(done)}; the databases are at offset {report.next_offset:,}")
    for letter in report.parked:
        say(f"parked: offset {letter.offset:,}: {letter.reason}")


@contextlib.contextmanager
def _stopped_by_signals() -> Iterator[threading.Event]:
    """SIGTERM and Ctrl-C end the tail after the current batch; a second Ctrl-C at once."""
    stop = threading.Event()

    def drain(_signum: int, _frame: FrameType | None) -> None:
        stop.set()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {s: signal.signal(s, drain) for s in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield stop
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
