"""``mapfold status``: state of the log and the databases."""

from dataclasses import asdict
from typing import Any

import typer

from eventsrc.log_info import LogInfo, log_info
from eventsrc.text import counted, visible
from projections.database.status import SinkStatus, Status, projection_status

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
from .terminal import display, emit, finish, say


def register(app: typer.Typer) -> None:
    """Add ``status`` to ``app``."""
    app.command()(status)


def status(
    log: LogArgument,
    db: DbOption = None,
    vector_db: VectorDbOption = None,
    assignments: SetOption = None,
    settings_file: SettingsOption = None,
    as_json: JsonOption = False,
) -> None:
    """Offsets, lag, checkpoints, dead letters, rejected, losses, versions; exit 3 on findings."""
    settings = settings_of(settings_file, assignments)
    info = log_info(log)
    with databases(db, vector_db) as targets:
        found = projection_status(log, targets, settings)
    if as_json:
        emit(
            {
                "log": {
                    "id": info.log_id,
                    "next_offset": info.events,
                    "rejected": info.rejected,
                    "lost": info.lost,
                },
                "sinks": {s.sink: _document(s) for s in found.sinks},
            }
        )
    else:
        _print(info, found)
    finish(findings=not found.healthy or bool(info.rejected) or bool(info.lost))


def _document(sink: SinkStatus) -> dict[str, Any]:
    """The status as JSON, with a refold's progress only while there is one."""
    document = asdict(sink)
    if sink.refold_total is None:
        del document["refold_done"], document["refold_total"]
    return document


def _print(info: LogInfo, found: Status) -> None:
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
        " cypher(); run mapfold replay with AGE 1.7 or later, or what mapfold db roles prints and"
        f" REVOKE USAGE ON SCHEMA ag_catalog FROM {them}"
    )


def _sink_line(sink: SinkStatus) -> str:
    versions = ", ".join(f"{name} {number}" for name, number in (sink.versions or {}).items())
    if sink.next_offset is None:
        return f"{sink.condition} · {sink.place}" + (f" · {versions}" if versions else "")
    lag = "" if sink.lag is None else f", {sink.lag:,} behind"
    condition: str = sink.condition
    if sink.refold_done is not None and sink.refold_total:
        condition += f", {100 * sink.refold_done // sink.refold_total} %, old map"
    return f"{condition} at offset {sink.next_offset:,}{lag} · {sink.place} · {versions}"
