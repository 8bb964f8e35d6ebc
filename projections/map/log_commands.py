"""The commands of a log, and the corrections that they make.

Commands are read by key: of sealed segments only the chunks that hold one, by their index. An event
on ``mapfold/command`` that is no command is an error that names its offset: leaving it out would
give another map than its author asked for.
"""

from eventsrc.base.advised import advised
from eventsrc.base.garbage import gc_paused
from eventsrc.envelope.commands import InvalidCommand, UnknownKind, UseSettings, parse_command
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import Event, LogReader
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.errors import FoldError, SettingsError
from projections.fold.settings import Settings


def read_command(event: Event) -> RecordedCommand:
    """The command of an event on ``mapfold/command``. Raises FoldError."""
    try:
        command = parse_command(event.payload)
        if isinstance(command, UseSettings):
            Settings.from_document(command.settings)
    except UnknownKind as error:
        raise FoldError(
            event.offset,
            f"{error}; update mapfold, or look at the map before it: {_before(event.offset)}",
        ) from None
    except (InvalidCommand, SettingsError) as error:
        raise FoldError(
            event.offset,
            f"it is on {COMMAND_KEY}, but no command that this version knows: {error}; update "
            f"mapfold, or look at the map before it: {_before(event.offset)}",
        ) from None
    return RecordedCommand(event.offset, command)


def _before(offset: Offset) -> str:
    return f"`{advised('state', '--at', offset)}`"


@gc_paused()
def read_commands(
    reader: LogReader, until: Offset | None = None, start: Offset = FIRST_OFFSET
) -> list[RecordedCommand]:
    """The commands from ``start`` to before ``until``, all for None, in order. Raises FoldError,
    LogDamaged."""
    events = reader.read(start, until, keys=(COMMAND_KEY,))
    return [read_command(event) for event in events]


@gc_paused()
def read_corrections(reader: LogReader, known_at: Offset | None = None) -> Corrections:
    """The corrections of the commands before ``known_at``, of all for None. Raises FoldError,
    LogDamaged."""
    return compile_corrections(read_commands(reader, known_at))
