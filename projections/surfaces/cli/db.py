"""``mapfold status`` and ``mapfold db``: the state of the log and the databases; the
embedded server, check and repair of the databases, roles."""

from dataclasses import asdict
from typing import Annotated, Any, get_args

import typer

from eventsrc.base.text import advised, counted, visible
from eventsrc.record.log_info import LogInfo, log_info
from projections.postgres import rebuild
from projections.postgres.check import CheckReport
from projections.postgres.check import check as check_projections
from projections.postgres.embedded import EmbeddedServer
from projections.postgres.labels import SinkName
from projections.postgres.queries.candidate_search import question_error
from projections.postgres.replaced_tables import roles_sql
from projections.postgres.status import SinkStatus, Status, projection_status, status_document

from .folded_log import LogSettings
from .options import Databases, JsonOption, OnlyOption, only_of
from .terminal import display, emit, finish, say

group = typer.Typer(
    help="Run the embedded PostgreSQL server; check and repair any database.",
    no_args_is_help=True,
)


@group.command()
def url(as_json: JsonOption = False) -> None:
    """Print the embedded server's URL (it answers while the server runs: see db start)."""
    server = EmbeddedServer()
    running = server.running
    if as_json:
        emit({"url": server.url, "data": str(server.data), "running": running, "kept": server.kept})
        return
    display(server.url)
    if not running:
        say(f"the server is not running; start it with: {advised('db', 'start')}")


@group.command()
def start(as_json: JsonOption = False) -> None:
    """Start the embedded server and leave it running until db stop."""
    server = EmbeddedServer().start(keep=True)
    address = server.url
    server.stop()
    if as_json:
        emit({"url": address, "data": str(server.data), "running": True, "kept": True})
        return
    display(address)
    say(f"running, with its data in {server.data}; stop it with: {advised('db', 'stop')}")


@group.command()
def stop(as_json: JsonOption = False) -> None:
    """Stop the embedded server, unless another command is using it right now."""
    server = EmbeddedServer()
    ran = server.running
    running = server.stop(discard_keep=True)
    if as_json:
        emit({"data": str(server.data), "running": running, "kept": False})
    elif running:
        say("another command is using the server; it stops when that command ends")
    else:
        say("stopped" if ran else "it was not running")


@group.command()
def reset(as_json: JsonOption = False) -> None:
    """Set the embedded server's data aside, damaged or not, and make new, empty data.

    Nothing is lost: replay makes the databases again from each log.
    """
    server = EmbeddedServer()
    aside = server.reset()
    if as_json:
        emit({"data": str(server.data), "aside": None if aside is None else str(aside)})
        return
    if aside is not None:
        say(f"set aside: {aside}; remove it when you do not need it")
    say(f"new and empty: {server.data}; fill it with: {advised('replay')}")


@group.command()
def check(
    *,
    only: OnlyOption = None,
    repair: Annotated[
        bool, typer.Option("--repair", help="Rebuild what differs, up to the same offset.")
    ] = False,
    databases: Databases,
    source: LogSettings,
    as_json: JsonOption = False,
) -> None:
    """Compare the databases with LOG at their checkpoints, row by row, and try one question; exit 3
    if they differ or it fails."""
    log, settings = source.log, source.checked()
    with databases.opened() as targets:
        reports = check_projections(log, targets, settings, only=only_of(only))
        wrong = [report for report in reports if report.differing]
        # A rebuild would drop the foreign tables in the graph.
        repaired = [report for report in wrong if repair and not report.foreign]
        for report in repaired:
            rebuild(
                log,
                targets,
                settings,
                until=report.next_offset,
                known_at=report.known_at,
                only=report.sink,
            )
        failure = question_error(targets) if len(reports) == len(get_args(SinkName)) else None
    if as_json:
        document = {"sinks": [_check_document(r) for r in reports], "repaired": bool(repaired)}
        emit(_with_failure(document, failure))
    else:
        _print_check(reports)
        _print_failure(failure)
        for report in repaired:
            say(f"{report.sink}: rebuilt")
        if wrong and not repair:
            say(f"to repair it run: {advised('db', 'check', '--repair', log)}")
        elif len(repaired) < len(wrong):
            say("graph: not rebuilt, as that would drop what is not ours; remove it first")
    finish(findings=failure is not None or not all(report.sound for report in reports))


@group.command()
def roles(only: OnlyOption = None) -> None:
    """Print SQL for two least-privilege roles: mapfold_reader and mapfold_writer."""
    display(roles_sql(("graph", "vectors") if only is None else (only.value,)))


def _check_document(report: CheckReport) -> dict[str, Any]:
    """The report as JSON, with ``known_at`` only where it is not the checkpoint's own offset."""
    document = asdict(report)
    if report.known_at == report.next_offset:
        del document["known_at"]
    return document


def _print_check(reports: list[CheckReport]) -> None:
    for report in reports:
        display(
            f"{report.sink}: {counted(report.rows, 'row')} at offset {report.next_offset:,},"
            f" {report.differing:,} differ"
        )
        for difference in report.differences:
            display(
                f"  {difference.kind} {difference.table} {difference.id}:"
                f" expected {difference.expected}, found {difference.found}"
            )
        if report.differing > len(report.differences):
            display(f"  and {report.differing - len(report.differences):,} more")
        for table in report.foreign:
            rows = "rows" if table.rows is None else counted(table.rows, "row")
            display(
                f"  not ours: {table.what} {table.table!r} with {rows}; a rebuild drops it."
                f" Keep a copy: {visible(table.keep)}; remove it: {visible(table.remove)};"
            )


def status(
    *,
    databases: Databases,
    source: LogSettings,
    as_json: JsonOption = False,
) -> None:
    """Show offsets, lag, checkpoints, dead letters, rejected, losses, versions; try one question.

    Exit 3 on findings.
    """
    log, settings = source.log, source.checked()
    info = log_info(log)
    with databases.opened() as targets:
        found = projection_status(log, targets, settings)
        away = any(sink.condition in ("missing", "unreachable") for sink in found.sinks)
        failure = None if away else question_error(targets)
    if as_json:
        emit(_with_failure(status_document(info, found), failure))
    else:
        _print_status(info, found)
        _print_failure(failure)
    wrong = not found.healthy or failure is not None
    finish(findings=wrong or bool(info.rejected) or bool(info.lost))


def _with_failure(document: dict[str, Any], failure: str | None) -> dict[str, Any]:
    """The document with ``question_error`` if questions cannot be answered."""
    return document if failure is None else document | {"question_error": failure}


def _print_failure(failure: str | None) -> None:
    if failure is not None:
        display(f"questions cannot be answered: {failure}")


def _print_status(info: LogInfo, found: Status) -> None:
    display(
        f"log      {info.log_id}: {counted(info.events, 'event')}, {info.rejected:,} rejected,"
        f" {info.lost:,} lost"
    )
    for sink in found.sinks:
        display(f"{sink.sink:<8} {_sink_line(sink)}")
        if sink.note:
            say(f"         {sink.note}")
        if sink.unwanted_writers:
            display(f"         {_unwanted_writers(sink.unwanted_writers)}")
        for letter in sink.dead_letters:
            run = f" (run {letter.run_id})" if letter.run_id else ""
            display(f"         parked: offset {letter.offset:,}{run}: {letter.reason}")


def _unwanted_writers(roles: tuple[str, ...]) -> str:
    them = ", ".join(map(visible, roles))
    return (
        f"not read-only: {them} may only read the graph, but Apache AGE lets them change it through"
        f" cypher(); run `{advised('replay')}` with AGE 1.7 or later, or what"
        f" `{advised('db', 'roles')}` prints and"
        f" REVOKE USAGE ON SCHEMA ag_catalog FROM {them}"
    )


def _sink_line(sink: SinkStatus) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in (sink.versions or {}).items())
    if sink.next_offset is None:
        return f"{sink.condition} · {sink.place}" + (f" · {versions}" if versions else "")
    lag = "" if sink.lag is None else f", {sink.lag:,} behind"
    old = ", old map" if sink.condition == "refolding" else ""
    return f"{sink.condition}{old} at offset {sink.next_offset:,}{lag} · {sink.place} · {versions}"
