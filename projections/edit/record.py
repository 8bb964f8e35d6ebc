"""Record a command: directly in the log, or by the recorder that holds it. The command is made from
the current map. If another command has been appended meanwhile, it is made again from the map after
that.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.advised import advised
from eventsrc.base.errors import LogBusy, MapfoldError, TransportError
from eventsrc.base.text import visible
from eventsrc.envelope.commands import Command, encode_command
from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.log.lock import is_held
from eventsrc.record.recorder.edits import NewerCommand, NoAnswer, send_command
from eventsrc.record.transport.session import Session
from projections.fold.corrections import check_settings
from projections.map.own_events import read_commands

from .conflicts import EditRefused
from .current import CurrentMap, SettingsOf
from .make import Stamp
from .outcome import Outcome, outcome_of

MakeCommand = Callable[[CurrentMap, Stamp], Command]
"""A function that makes the command from the current map. Raises MisuseError."""
OpenSession = Callable[[], AbstractContextManager[Session]]
TIMEOUT_S: Final = 10.0
_TRIES: Final = 10


class _LogFree(Exception):
    """The writer that held the log has ended."""


class Made(NamedTuple):
    """A command, the map that it was made from, and its outcome; ``offset`` is None if it is not
    recorded, ``repeated`` if it was recorded by an earlier call."""

    command: Command
    current: CurrentMap
    outcome: Outcome
    offset: Offset | None
    repeated: bool = False


def make_command(
    reader: LogReader,
    make: MakeCommand,
    stamp: Stamp,
    settings_of: SettingsOf,
    note: Callable[[str], None],
) -> Made:
    """Make a command, fold the log with it, and record nothing. One that is in the log already is
    made as it was made then. Raises MisuseError, also if the log has another command of this id or
    cannot be folded with this one."""
    current = CurrentMap(reader, settings_of, note=note)
    known = current.find_command(stamp.command_id)
    if known is not None:
        current = CurrentMap(reader, settings_of, until=known.offset, note=note)
    command = make(current, stamp)
    check_settings(command)
    if known is not None and known.command != command:
        raise EditRefused(
            f"--command-id {visible(stamp.command_id)} is that of another command, at offset "
            f"{known.offset} (see `{advised('edits')}`); give another or none"
        )
    outcome = outcome_of(current, command, recorded=known is not None)
    offset = known.offset if known else None
    return Made(command, current, outcome, offset, repeated=known is not None)


def record_command(
    log: Path,
    make: MakeCommand,
    stamp: Stamp,
    settings_of: SettingsOf,
    open_session: OpenSession,
    note: Callable[[str], None] = lambda _: None,
) -> Made:
    """Make a command and append it; returns when it is durable.

    Raises MisuseError, LogError, TransportError, or LogBusy when the log is held by a writer that
    takes no commands.
    """
    for _ in range(_TRIES):
        with LogReader(log) as reader:
            made = make_command(reader, make, stamp, settings_of, note)
            if made.repeated:
                return made
            try:
                return made._replace(offset=_append(log, made, open_session))
            except NewerCommand as newer:
                last: MapfoldError = newer
            except _LogFree:
                last = LogBusy(f"{log} is written by one writer after another; try again")
    raise last


def _append(log: Path, made: Made, open_session: OpenSession) -> Offset:
    try:
        writer = LogWriter(log)
    except LogBusy as busy:
        return _send(log, made, open_session, str(busy))
    with writer:
        with LogReader(log) as reader:
            commands = read_commands(reader)
        if commands and commands[-1].offset >= made.current.known_at:
            raise NewerCommand(commands[-1].offset)
        offset = Offset(writer.append(COMMAND_KEY, encode_command(made.command)))
        writer.sync()
    return offset


def _send(log: Path, made: Made, open_session: OpenSession, busy: str) -> Offset:
    command, current = made.command, made.current
    try:
        with open_session() as session:
            known_at = current.known_at
            log_id = current.reader.log_id
            return send_command(session, log_id, command, known_at, timeout_s=TIMEOUT_S).offset
    except NoAnswer:
        found = _find(log, command)  # the recorder may have ended between its sync and its reply
        if found is not None:
            return found
        _check_held(log)
        raise LogBusy(
            f"{busy.partition(';')[0]}, and no recorder answers for it; start the recorder with "
            "--accept-edits, or stop it and edit again; if it runs with --accept-edits, --connect "
            f"must name its router. `--command-id {visible(command.command_id)}` makes sure that "
            "the command is recorded once"
        ) from None
    except TransportError as error:
        _check_held(log)
        raise LogBusy(
            f"{busy.partition(';')[0]}; a recorder takes commands over Zenoh, but {error}"
        ) from None


def _check_held(log: Path) -> None:
    """Raise _LogFree if the writer that held the log, such as another `edit`, has ended."""
    if not is_held(log):
        raise _LogFree


def _find(log: Path, command: Command) -> Offset | None:
    with LogReader(log) as reader:
        commands = read_commands(reader)
    for recorded in commands:
        if recorded.command == command:
            return recorded.offset
    return None
