"""State of the databases compared with a log: lag, writer, dead letters, versions.

A sink is *following* while a live tail writes it, with every event or still catching up; *stalled*
when its tail has had no heartbeat for ``STALLED_S``; *refolding* while its tail folds the log again
because of a command; *rebuilding* while a replay writes it. Without a writer it is *idle* when it
has every event and *behind* when not. It is *other* when it was made from another log, with other
settings or under other corrections than its commands give.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Literal

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.record.log_info import LogInfo
from projections.fold.map_errors import DatabaseError, ProjectionMismatch
from projections.fold.settings import Settings

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_connection,
    describe_target,
    extension_version,
)
from .cypher import unwanted_writers
from .inputs import LogInputs, SettingsOf
from .labels import SINKS, SinkName
from .origin import command_for, refuse_other_origin, replay_advice
from .sink import Checkpoint

STALLED_S: Final = 20.0
"""A live tail's heartbeat comes every 5 s."""

Condition = Literal[
    "missing",
    "other",
    "idle",
    "following",
    "refolding",
    "rebuilding",
    "stalled",
    "behind",
    "unreachable",
]


@dataclass(frozen=True, slots=True)
class SinkStatus:
    """One sink. Ages are seconds; ``note`` explains ``other`` and ``unreachable``.

    ``lag`` is None when it was made from another log, or a longer one. ``unwanted_writers`` are
    roles without the privilege to write that Apache AGE lets write nevertheless.
    """

    sink: SinkName
    place: str
    condition: Condition
    note: str | None = None
    next_offset: Offset | None = None
    lag: int | None = None
    checkpoint_age_s: float | None = None
    heartbeat_age_s: float | None = None
    writer: str | None = None
    digest: str | None = None
    dead_letters: tuple[DeadLetter, ...] = ()
    versions: dict[str, str] | None = None
    unwanted_writers: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Status:
    """A log's end and the two sinks."""

    log_id: str
    log_next_offset: Offset
    sinks: tuple[SinkStatus, ...]

    @property
    def healthy(self) -> bool:
        """True unless a sink is not up to date, has parked events or can be written by readers."""
        good = ("idle", "following", "refolding", "rebuilding")
        return all(
            s.condition in good and not s.dead_letters and not s.unwanted_writers
            for s in self.sinks
        )


def projection_status(log: Path, targets: Targets, settings: Settings | SettingsOf) -> Status:
    """State of both sinks. A database that cannot be reached is a finding, not an error.

    Raises FoldError for a command in the log that cannot be read.
    """
    with LogReader(log) as reader:
        found = tuple(
            _reachable_status(sink, targets.url_of(sink), reader, settings) for sink in SINKS
        )
        return Status(reader.log_id, reader.next_offset, found)


def _reachable_status(
    sink: SinkName, url: str, reader: LogReader, settings: Settings | SettingsOf
) -> SinkStatus:
    try:
        opened = connect(url, application="mapfold status", autocommit=True)
        with opened as connection, database_errors(url):
            return _sink_status(connection, sink, reader, settings)
    except ProjectionMismatch as error:
        return SinkStatus(sink, describe_target(url), "other", note=str(error))
    except DatabaseError as error:
        return SinkStatus(sink, describe_target(url), "unreachable", note=str(error))


def _sink_status(
    connection: Connection, sink: SinkName, reader: LogReader, settings: Settings | SettingsOf
) -> SinkStatus:
    where = describe_connection(connection)
    versions = _versions(connection)
    found = checkpoints.load(connection, sink)
    writer = checkpoints.writer(connection, sink)
    # After the checkpoint, which otherwise could know a command that we do not.
    end = reader.refresh()
    inputs = LogInputs.read(reader, settings)
    if found is None and writer is not None:
        return SinkStatus(sink, where, _working(writer), writer=writer, versions=versions)
    if found is None:
        replay = command_for("replay", reader.path, inputs.latest)
        advice = f"nothing has been projected there; run: {replay}"
        return SinkStatus(sink, where, "missing", note=advice, versions=versions)
    if not checkpoints.rows_exist(connection, sink):
        dropped = f"the tables of its {found.next_offset:,} events were dropped"
        advice = f"{dropped}; {replay_advice(reader.path, inputs.latest)}"
        return SinkStatus(sink, where, "missing", note=advice, versions=versions)
    moved, heartbeat = checkpoints.ages(connection, sink)
    is_silent = heartbeat is None or heartbeat > STALLED_S
    condition, note = _condition(found, sink, where, reader, inputs)
    if condition != "other" and writer is not None:
        condition, note = _working(writer), None
        if condition == "following" and is_silent:
            condition = "stalled"
            note = "a tail holds it but sends no heartbeat; look at that process"
    is_of_log = found.log_id == reader.log_id and found.next_offset <= end
    return SinkStatus(
        sink,
        where,
        condition,
        note,
        found.next_offset,
        end - found.next_offset if is_of_log else None,
        round(moved, 3),
        None if heartbeat is None else round(heartbeat, 3),
        writer,
        found.digest,
        tuple(checkpoints.parked(connection, sink)),
        versions,
        tuple(unwanted_writers(connection)) if sink == "graph" else (),
    )


def _condition(
    found: Checkpoint, sink: SinkName, where: str, reader: LogReader, inputs: LogInputs
) -> tuple[Condition, str | None]:
    """The condition of a sink that no process writes, and why."""
    advice, end = replay_advice(reader.path, inputs.latest), reader.next_offset
    try:
        refuse_other_origin(found, sink, where, reader.log_id, inputs.at(found.known_at), advice)
    except ProjectionMismatch as error:
        return "other", str(error)
    if found.next_offset > end:
        return "other", f"the log has only {end:,} events; {advice}"
    unknown = inputs.since(found.known_at)
    if found.next_offset == end and not unknown:
        return "idle", None
    note = f"no process writes it; run: {command_for('tail', reader.path, inputs.latest)}"
    if unknown:
        commands, last = counted(len(unknown), "command"), unknown[-1].offset
        note = f"{commands} came since, the last at offset {last:,}; {note}"
    return "behind", note


def _working(writer: str) -> Condition:
    of_tail: dict[str, Condition] = {
        checkpoints.FOLLOWING: "following",
        checkpoints.REFOLDING: "refolding",
    }
    return of_tail.get(writer, "rebuilding")


def _versions(connection: Connection) -> dict[str, str]:
    versions = {"postgresql": str(connection.info.server_version // 10000)}
    row = connection.execute("SHOW server_version").fetchone()
    if row is not None:
        versions["postgresql"] = str(row[0])
    for name in ("age", "vector"):
        version = extension_version(connection, name)
        if version is not None:
            versions[name] = version
    return versions


def status_document(info: LogInfo, found: Status) -> dict[str, Any]:
    """The state of a log and its databases as JSON."""
    return {
        "log": {
            "id": info.log_id,
            "next_offset": info.events,
            "rejected": info.rejected,
            "lost": info.lost,
        },
        "sinks": {s.sink: asdict(s) for s in found.sinks},
    }
