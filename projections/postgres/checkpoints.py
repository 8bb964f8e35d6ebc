"""Checkpoints, dead letters and the one-writer lock of a database, in its schema ``mapfold``."""

import json
import time
from dataclasses import asdict, dataclass
from typing import Final

from psycopg import sql

from eventsrc.base.text import advised
from eventsrc.envelope.model import Offset, RunId
from eventsrc.log import Event
from projections.fold import FOLD_VERSION
from projections.fold.map_errors import (
    CheckpointMoved,
    DatabaseError,
    ProjectionBusy,
    ProjectionMismatch,
)

from .connection import Connection, describe_connection, statements
from .labels import SINKS, SinkName
from .sink import Checkpoint

_OURS: Final = "mapfold"
_OF_THIS_VERSION: Final = f"mapfold 2.{FOLD_VERSION}:"
"""The beginning of the schema's comment. Another first number is another layout of the tables, the
graph or the vectors, another second one stands for other rules of the map: only a replay helps."""
FOLLOWING: Final = "mapfold tail"
REFOLDING: Final = "mapfold tail, refolding"
"""The names of a tail's sessions."""
LOCK_GRACE_S: Final = 1.0
"""Wait for the writer's lock: a server takes a moment to notice that the last writer's connection
has ended."""
LOCK_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class DeadLetter:
    """An event that could not be folded and was left out. ``run_id`` is None when unreadable."""

    offset: Offset
    key: str
    run_id: RunId | None
    reason: str


def lock_writer(connection: Connection, sink: SinkName) -> None:
    """Lock a sink for writing until the connection ends. Raises ProjectionBusy."""
    number = {"number": SINKS[sink].writer_lock}
    deadline = time.monotonic() + LOCK_GRACE_S
    while True:
        row = connection.execute(statements("checkpoint")["lock"], number).fetchone()
        if row is not None and row[0]:
            return
        if time.monotonic() > deadline:
            break
        time.sleep(LOCK_POLL_S)
    holder = connection.execute(statements("checkpoint")["lock_holder"], number).fetchone()
    # The writer may run on any machine; the database only knows its session.
    who = f" ({holder[1]}; PostgreSQL serves it in process {holder[0]})" if holder else ""
    raise ProjectionBusy(
        f"{describe_connection(connection)}: another rebuild or tail{who} is writing the {sink}"
        " there; wait for it or stop it"
    )


def writer(connection: Connection, sink: SinkName) -> str | None:
    """Name of the application that holds the sink's lock; None when it is free."""
    number = {"number": SINKS[sink].writer_lock}
    row = connection.execute(statements("checkpoint")["lock_holder"], number).fetchone()
    return None if row is None else str(row[1])


def has_schema(connection: Connection) -> bool:
    """Whether the schema ``mapfold`` exists. Raises DatabaseError when it is not ours, and
    ProjectionMismatch when another version of mapfold made it."""
    made_by = _made_by(connection)
    if made_by is not None and not made_by.startswith(_OF_THIS_VERSION):
        raise ProjectionMismatch(
            f"{describe_connection(connection)}: another version of mapfold made the map there; run"
            f" `{advised('replay')}`, which makes it again"
        )
    return made_by is not None


def _made_by(connection: Connection) -> str | None:
    row = connection.execute(statements("checkpoint")["schema_owner"]).fetchone()
    if row is not None and not str(row[0]).startswith(_OURS):
        raise DatabaseError(
            f"{describe_connection(connection)}: has a schema mapfold that mapfold did not make;"
            " use another database"
        )
    return None if row is None else str(row[0])


def ensure_schema(connection: Connection) -> None:
    """Create the schema ``mapfold`` and its tables."""
    if not has_schema(connection):
        made_by = f"{_OF_THIS_VERSION} progress of the projections; made and removed by mapfold"
        create = statements("checkpoint")["create"]
        connection.execute(create.format(made_by=sql.Literal(made_by)))


def drop_other_version(connection: Connection) -> None:
    """Drop the schema ``mapfold`` if another version made it."""
    made_by = _made_by(connection)
    if made_by is not None and not made_by.startswith(_OF_THIS_VERSION):
        connection.execute("DROP SCHEMA mapfold CASCADE")


def load(connection: Connection, sink: SinkName) -> Checkpoint | None:
    """The sink's checkpoint; None when nothing has been projected."""
    if not has_schema(connection):
        return None
    row = connection.execute(statements("checkpoint")["load"], {"sink": sink}).fetchone()
    return None if row is None else Checkpoint(*row)


def rows_exist(connection: Connection, sink: SinkName) -> bool:
    """Whether the sink's graph or table still exists."""
    first = sql.Identifier(*SINKS[sink].tables[0]).as_string(connection)
    row = connection.execute(statements("checkpoint")["rows_exist"], {"table": first}).fetchone()
    return row is not None and bool(row[0])


def create(connection: Connection, sink: SinkName, first: Checkpoint) -> None:
    """Insert a checkpoint at offset 0, if there is none."""
    connection.execute(statements("checkpoint")["create_first"], {"sink": sink, **asdict(first)})


def advance(
    connection: Connection, sink: SinkName, before: Checkpoint, after: Checkpoint
) -> Checkpoint:
    """Move the checkpoint, in the transaction of the rows. Raises CheckpointMoved."""
    cursor = connection.execute(
        statements("checkpoint")["advance"],
        {
            "sink": sink,
            **asdict(after),
            "expected": before.next_offset,
            "expected_fingerprint": before.fingerprint,
        },
    )
    if cursor.fetchone() is not None:
        return after
    found = load(connection, sink)
    raise CheckpointMoved(
        f"{describe_connection(connection)}: the checkpoint of the {sink} was expected at offset"
        f" {before.next_offset:,} of log {before.log_id}, but is"
        f" {f'at {found.next_offset:,} of log {found.log_id}' if found else 'gone'}: something else"
        " writes there; stop it, then start again"
    )


def replace(connection: Connection, sink: SinkName, checkpoint: Checkpoint) -> None:
    """Write a rebuild's checkpoint and delete the dead letters."""
    connection.execute(statements("checkpoint")["replace"], {"sink": sink, **asdict(checkpoint)})
    connection.execute(statements("checkpoint")["unpark"], {"sink": sink})


def park(connection: Connection, sink: SinkName, letter: DeadLetter) -> None:
    """Record an event that was left out, in the transaction that moves past it."""
    connection.execute(
        statements("checkpoint")["park"],
        {
            "sink": sink,
            "log_offset": letter.offset,
            "key": letter.key,
            "run_id": letter.run_id,
            "reason": letter.reason,
        },
    )


def parked(connection: Connection, sink: SinkName) -> list[DeadLetter]:
    """The dead letters, by offset."""
    if not has_schema(connection):
        return []
    rows = connection.execute(statements("checkpoint")["parked"], {"sink": sink}).fetchall()
    return [DeadLetter(*row) for row in rows]


def write_heartbeat(connection: Connection, sink: SinkName) -> None:
    """Record that the sink's tail is alive."""
    connection.execute(statements("checkpoint")["write_heartbeat"], {"sink": sink})


def name_session(connection: Connection, name: str) -> None:
    """Change what `writer` returns for the sinks that this session holds."""
    connection.execute(statements("checkpoint")["name_session"], {"name": name})


def ages(connection: Connection, sink: SinkName) -> tuple[float, float | None]:
    """Seconds since the checkpoint moved, and since its tail's last heartbeat (None: never)."""
    row = connection.execute(statements("checkpoint")["ages"], {"sink": sink}).fetchone()
    return (0.0, None) if row is None else (row[0], row[1])


def dead_letter(event: Event, reason: str) -> DeadLetter:
    """The dead letter of an event."""
    return DeadLetter(event.offset, event.key, _run_id(event.payload), reason)


def _run_id(payload: bytes) -> RunId | None:
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    run_id = document.get("run_id") if isinstance(document, dict) else None
    return RunId(run_id) if isinstance(run_id, str) and "\0" not in run_id else None
