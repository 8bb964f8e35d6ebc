"""Checkpoints, dead letters and the one-writer lock of a database, in its schema ``mapfold``.

Commands to run next, with the settings they need, for messages about a checkpoint.

What is kept of an event that could not be folded.
"""

import hashlib
import json
import shlex
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from eventsrc.log import Event
from projections.errors import CheckpointMoved, DatabaseError, ProjectionBusy, ProjectionMismatch
from projections.settings import Settings

from .connection import Connection, describe_connection
from .labels import GRAPH, LABELS, TABLE
from .sink import Checkpoint, SinkName
from .statements import statements

_BY_PROGRAMS_ONLY = "neighbourhood"


def command(name: str, log: Path, settings: Settings, *options: str) -> str:
    """``mapfold NAME LOG`` with ``options`` and the ``--set`` for all that is not as by default."""
    default = Settings().model_dump()
    changed = [key for key, value in settings.model_dump().items() if value != default[key]]
    words = ["mapfold", name, shlex.quote(str(log)), *options, *_options(settings, changed)]
    return " ".join(words)


def remake(log: Path, settings: Settings) -> str:
    """What to do about a projection that does not fit the log or the settings."""
    return f"to make the map anew run: {command('replay', log, settings)}"


def differences(before: str, settings: Settings) -> list[str]:
    """What is another than in a checkpoint's settings: ``eps_m=0.75 there, 1.5 here``."""
    old, new = json.loads(before), json.loads(settings.model_dump_json())
    return [
        f"{name}={old.get(name)} there, {new.get(name)} here" for name in _different(old, new)
    ] or ["made by another version"]


def fitting(before: str, settings: Settings) -> str | None:
    """The ``--set`` options that make ``settings`` those of a checkpoint; None if none can."""
    try:
        old = Settings.model_validate_json(before)
    except ValidationError:
        return None
    changed = _different(old.model_dump(), settings.model_dump())
    if _BY_PROGRAMS_ONLY in changed:
        return None
    return " ".join(_options(old, changed)) or None


def _options(settings: Settings, names: Iterable[str]) -> list[str]:
    values = settings.model_dump()
    return [
        f"--set {shlex.quote(f'{name}={_said(values[name])}')}"
        for name in names
        if name != _BY_PROGRAMS_ONLY
    ]


def _said(value: object) -> str:
    return "none" if value is None else str(value)


def _different(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    return [name for name in sorted(old.keys() | new.keys()) if old.get(name) != new.get(name)]


_LOCK_NUMBERS: Final[dict[SinkName, int]] = {"graph": 1, "vectors": 2}
_ONE_OF: Final[dict[SinkName, str]] = {
    "graph": f'{GRAPH}."{LABELS[0]}"',
    "vectors": f"public.{TABLE}",
}
_MARK: Final = "mapfold"
_WAS: Final[dict[SinkName, str]] = {"graph": "was", "vectors": "were"}
LOCK_GRACE_S: Final = 1.0
"""A server notices only after a moment that the last writer's connection has ended."""
LOCK_POLL_S: Final = 0.02


@dataclass(frozen=True, slots=True)
class DeadLetter:
    """An event that could not be folded and was left out. ``run_id`` when its payload tells one."""

    offset: int
    key: str
    run_id: str | None
    reason: str


def event_hash(event: Event | None) -> str:
    """Identifies an event by all it holds; "" for none."""
    if event is None:
        return ""
    head = json.dumps([event.offset, event.key, event.logged_ns, event.stamp_ns]).encode()
    return hashlib.sha256(head + b"\n" + event.payload).hexdigest()


def lock_writer(connection: Connection, sink: SinkName) -> None:
    """Be the only writer of a sink until the connection ends. Raises ProjectionBusy."""
    number = {"number": _LOCK_NUMBERS[sink]}
    deadline = time.monotonic() + LOCK_GRACE_S
    while True:
        row = connection.execute(statements("checkpoint")["lock"], number).fetchone()
        if row is not None and row[0]:
            return
        if time.monotonic() > deadline:
            break
        time.sleep(LOCK_POLL_S)
    holder = connection.execute(statements("checkpoint")["lock_holder"], number).fetchone()
    # The writer itself may run on any machine; what the database knows is its session.
    who = f" ({holder[1]}; PostgreSQL serves it in process {holder[0]})" if holder else ""
    raise ProjectionBusy(
        f"{describe_connection(connection)}: another rebuild or tail{who} is writing the {sink}"
        " there; wait for it or stop it"
    )


def writer_of(connection: Connection, sink: SinkName) -> str | None:
    """The application that holds the sink's lock, None when nobody does."""
    number = {"number": _LOCK_NUMBERS[sink]}
    row = connection.execute(statements("checkpoint")["lock_holder"], number).fetchone()
    return None if row is None else str(row[1])


def has_store(connection: Connection) -> bool:
    """Whether the schema ``mapfold`` is there. Raises when somebody else's is."""
    row = connection.execute(statements("checkpoint")["schema_owner"]).fetchone()
    if row is None:
        return False
    if not str(row[0]).startswith(_MARK):
        raise DatabaseError(
            f"{describe_connection(connection)}: has a schema mapfold that mapfold did not make;"
            " use another database"
        )
    return True


def ensure_store(connection: Connection) -> None:
    """Create the schema ``mapfold`` and its tables if they are missing."""
    if not has_store(connection):
        connection.execute(statements("checkpoint")["create"])


def load(connection: Connection, sink: SinkName) -> Checkpoint | None:
    """The sink's checkpoint; None when nothing has been projected."""
    if not has_store(connection):
        return None
    row = connection.execute(statements("checkpoint")["load"], {"sink": sink}).fetchone()
    return None if row is None else Checkpoint(*row)


def is_there(connection: Connection, sink: SinkName) -> bool:
    """Whether the sink's rows have somewhere to be: somebody may have dropped it."""
    row = connection.execute(
        statements("checkpoint")["is_there"], {"table": _ONE_OF[sink]}
    ).fetchone()
    return row is not None and bool(row[0])


def begin(connection: Connection, sink: SinkName, log_id: str, settings: Settings) -> None:
    """Make a checkpoint at offset 0, if there is none."""
    connection.execute(
        statements("checkpoint")["begin"],
        {
            "sink": sink,
            "log_id": log_id,
            "fingerprint": settings.fingerprint(),
            "settings": settings.model_dump_json(),
        },
    )


def advance(
    connection: Connection, sink: SinkName, before: Checkpoint, next_offset: int, last_event: str
) -> Checkpoint:
    """Move the checkpoint, in the transaction of the rows. Raises CheckpointMoved."""
    cursor = connection.execute(
        statements("checkpoint")["advance"],
        {
            "sink": sink,
            "log_id": before.log_id,
            "fingerprint": before.fingerprint,
            "expected": before.next_offset,
            "next_offset": next_offset,
            "last_event": last_event,
        },
    )
    after = Checkpoint(before.log_id, before.fingerprint, before.settings, next_offset, last_event)
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
    """Put down a rebuild's checkpoint and forget the dead letters of the past."""
    connection.execute(
        statements("checkpoint")["replace"],
        {
            "sink": sink,
            "log_id": checkpoint.log_id,
            "fingerprint": checkpoint.fingerprint,
            "settings": checkpoint.settings,
            "next_offset": checkpoint.next_offset,
            "last_event": checkpoint.last_event,
            "digest": checkpoint.digest,
        },
    )
    connection.execute(statements("checkpoint")["unpark"], {"sink": sink})


def park(connection: Connection, sink: SinkName, letter: DeadLetter) -> None:
    """Keep word of an event that was left out, in the transaction that moves past it."""
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
    """The events left out, by offset."""
    if not has_store(connection):
        return []
    rows = connection.execute(statements("checkpoint")["parked"], {"sink": sink}).fetchall()
    return [DeadLetter(*row) for row in rows]


def beat(connection: Connection, sink: SinkName) -> None:
    """Say that the sink's tail lives."""
    connection.execute(statements("checkpoint")["beat"], {"sink": sink})


def ages(connection: Connection, sink: SinkName) -> tuple[float, float | None]:
    """Seconds since the checkpoint moved, and since its tail last said that it lives."""
    row = connection.execute(statements("checkpoint")["ages"], {"sink": sink}).fetchone()
    return (0.0, None) if row is None else (row[0], row[1])


def refuse_other_origin(
    found: Checkpoint, sink: SinkName, where: str, log_id: str, settings: Settings, advice: str
) -> None:
    """Raise ProjectionMismatch when a checkpoint is of another log or other settings."""
    if found.log_id != log_id:
        raise ProjectionMismatch(
            f"{where}: the {sink} there {_WAS[sink]} made from log {found.log_id}, not from"
            f" {log_id}; {advice}"
        )
    if found.fingerprint != settings.fingerprint():
        options = fitting(found.settings, settings)
        raise ProjectionMismatch(
            f"{where}: the {sink} there {_WAS[sink]} made with other settings"
            f" ({', '.join(differences(found.settings, settings))});"
            f"{f' to go on with them add {options};' if options else ''} {advice}"
        )


def dead_letter(event: Event, reason: str) -> DeadLetter:
    """Where it stands in the log, why it was left out, and its run if the payload still tells."""
    return DeadLetter(event.offset, event.key, _run_id(event.payload), reason)


def _run_id(payload: bytes) -> str | None:
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    run_id = document.get("run_id") if isinstance(document, dict) else None
    return run_id if isinstance(run_id, str) and "\0" not in run_id else None
