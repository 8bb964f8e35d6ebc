"""``mapfold replay`` and ``mapfold tail``: rebuild the databases from a log, and keep
them at its end.

A replay prints how many events were left out, and why.
"""

import contextlib
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.record.transport.config import parse_address
from projections.fold.settings import Settings
from projections.map.parsed_log import DEFAULT_WORKERS, MAX_WORKERS
from projections.map.records import counts_text
from projections.map.state_output import places_advice
from projections.postgres import (
    ForeignEmbedding,
    RebuildReport,
    TailProgress,
    TailReport,
    rebuild,
    tail,
)
from projections.postgres.batch_writer import serving_tail_metrics
from projections.postgres.origin import command_line

from .folded_log import LogSettings, W
from .options import Databases, JsonOption, OnlyOption, only_of, option
from .signals import stop_on_signals
from .terminal import Bar, emit, finish, say, say_metrics


def left_out(
    log: Path, settings: Settings, report: RebuildReport, logged: Settings | None = None
) -> str | None:
    """One line about keyframes and observations that a replay left out, with advice; None if there
    are none.

    ``logged`` are the settings that the log names.
    """
    parts = "; ".join(_left_out_parts(log, settings, report, logged))
    return f"left out: {parts}" if parts else None


def _left_out_parts(
    log: Path, settings: Settings, report: RebuildReport, logged: Settings | None
) -> Iterator[str]:
    counts = report.counts
    if counts["duplicates"]:
        yield f"{counted(counts['duplicates'], 'keyframe')} that came twice"
    if counts["conflicts"]:
        yield (
            f"{counted(counts['conflicts'], 'keyframe')} that came again with other content (the"
            " first one stands; give every run a run_id of its own)"
        )
    if counts["det_ids_reused"]:
        yield (
            f"{counted(counts['det_ids_reused'], 'observation')} with the det_id of an earlier"
            " keyframe (omit det_id, or make it unique)"
        )
    if report.foreign is not None:
        yield _foreign_text(log, settings, report, report.foreign, logged)


def _foreign_text(
    log: Path,
    settings: Settings,
    report: RebuildReport,
    first: ForeignEmbedding,
    logged: Settings | None,
) -> str:
    many = counted(report.counts["foreign_embeddings"], "embedding")
    chosen = settings.embedding_model is not None or settings.embedding_dim is not None
    why = "as the settings say" if chosen else "as the log's first one is"
    if first.map_dim is None:
        wanted = _space_text(settings.embedding_model or "any model", settings.embedding_dim)
    else:
        wanted = _space_text(first.map_model or "an unnamed model", first.map_dim)
    came = _space_text(first.model or "an unnamed model", first.dim)
    instead = command_line("replay", log, _settings_for(settings, first), logged=logged)
    return (
        f"{many} of another space: the map's are of {wanted}, {why}, but that of {first.det_id} at"
        f" offset {first.offset:,} is of {came}; to map that space instead run: {instead}"
    )


def _space_text(model: str, dim: int | None) -> str:
    return model if dim is None else f"{model} with {counted(dim, 'dimension')}"


def _settings_for(settings: Settings, first: ForeignEmbedding) -> Settings:
    update: dict[str, str | int | None] = {"embedding_dim": first.dim}
    if first.model != first.map_model or first.map_dim is None:
        update["embedding_model"] = first.model
    return settings.model_copy(update=update)


WorkersOption = Annotated[
    int | None,
    option(
        "N",
        "Processes that read and parse a large LOG ahead of this one. Default: as many as"
        f" there are further processors, at most {DEFAULT_WORKERS}.",
        "--workers",
        min=0,
        max=MAX_WORKERS,
    ),
]


def replay(
    *,
    until: Annotated[str, option("W", f"Fold to here: {W}.", "--until")] = "end",
    only: OnlyOption = None,
    databases: Databases,
    source: LogSettings,
    no_hnsw: Annotated[
        bool, typer.Option("--no-hnsw", help="Do not index a large table for vector search.")
    ] = False,
    workers: WorkersOption = None,
    as_json: JsonOption = False,
) -> None:
    """Rebuild the databases from LOG. Readers see the old map until the new one is whole."""
    with source.opened(until) as (_, end, _, corrections, settings):
        log = source.log
    with databases.opened() as targets, Bar() as bar:
        report = rebuild(
            log,
            targets,
            settings,
            until=end,
            only=only_of(only),
            hnsw=not no_hnsw,
            workers=workers,
            progress=lambda at: bar.show(at.stage, at.done, at.total),
        )
    if as_json:
        emit(asdict(report))
    else:
        _print_rebuilt(log, settings, report, corrections.settings)


def _print_rebuilt(
    log: Path, settings: Settings, report: RebuildReport, logged: Settings | None
) -> None:
    rows = sum(report.rows.values())
    rate = report.events / report.total_s if report.total_s else 0.0
    say(
        f"{log}: {counted(report.events, 'event')}, {counted(rows, 'row')}"
        f" in {report.total_s:.2f} s ({rate:,.0f} events/s); digest {report.digest[:16]}"
    )
    counts = report.counts
    found = [counted(counts[f"{word}s"], word) for word in ("run", "keyframe", "observation")]
    objects = counts_text(counts["objects"], report.seen_once)
    say(", ".join([*found, objects, counted(counts["places"], "place")]))
    if report.lost_workers:
        say(
            f"{report.lost_workers} of the {report.workers} processes that parsed the log died,"
            " perhaps for lack of memory; their part was parsed again"
        )
    if report.hnsw is not None:
        say(f"vector search: {report.hnsw.reason}")
    for line in (left_out(log, settings, report, logged), places_advice(counts, settings)):
        if line is not None:
            say(line)


def tail_command(
    *,
    once: Annotated[bool, typer.Option("--once", help="Stop when caught up.")] = False,
    only: OnlyOption = None,
    databases: Databases,
    source: LogSettings,
    metrics: Annotated[
        str | None, option("PORT", "Serve Prometheus metrics; PORT or HOST:PORT.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Keep the databases live while LOG grows; what cannot be folded is parked and listed."""
    log, settings = source.log, source.checked()
    address = None if metrics is None else parse_address(metrics, "--metrics")
    progress = TailProgress()
    with LogReader(log) as reader:
        end = reader.next_offset
    with (
        stop_on_signals() as stop,
        databases.opened() as targets,
        _metrics(address, progress, log),
        Bar() as bar,
    ):
        report = tail(
            log,
            targets,
            settings,
            once=once,
            only=only_of(only),
            stop=stop,
            progress=progress,
            on_fold=_CatchUpBar(log, end, bar, once).show,
            on_refold=_RefoldNote().show,
            on_trouble=lambda what: _report_failure(what, progress),
            note=say,
        )
    if as_json:
        emit(_document(report))
    else:
        _print_followed(report)
    finish(findings=bool(report.parked))


@contextlib.contextmanager
def _metrics(address: tuple[str, int] | None, progress: TailProgress, log: Path) -> Iterator[None]:
    if address is None:
        yield
        return
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

    def show(self, done: int, total: int) -> None:
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


def _print_followed(report: TailReport) -> None:
    done = []
    if report.refolds:
        done.append(f"refolded {counted(report.refolds, 'time')} because of commands")
    if report.batches or not report.refolds:
        batches = "batch" if report.batches == 1 else "batches"
        done.append(f"{counted(report.events, 'event')} written in {report.batches:,} {batches}")
    say(f"{'; '.join(done)}; the databases are at offset {report.next_offset:,}")
    for letter in report.parked:
        say(f"parked: offset {letter.offset:,}: {letter.reason}")
