"""Commands over Zenoh to the recorder that holds a log: the query, its replies, and who answers.

A recorder started with ``--accept-edits`` answers queries to ``mapfold/edit/<log id>``. The payload
is a command's JSON (`eventsrc.envelope.commands`). The parameter ``known_at=N`` says that the
sender made the command knowing all commands before offset N; if the log has a later one, the
command is not recorded, so that a map that has changed meanwhile is not edited. Without it the
command is recorded whatever came before.

The reply is a `Recorded`, sent when the event is durable. A command whose ``command_id`` the log
has is not recorded again; the reply then names the offset that it has. An error reply is a
`Declined`.

In the recorder Zenoh's thread makes an `EditRequest` and puts it into the queue, or refuses it when
it is too large or too many wait. The writer thread gives it to `Edits`, which checks and appends
the command, and replies when the event is durable.
"""

import hashlib
from collections import deque
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from pydantic import ValidationError

from eventsrc.base.errors import LogDamaged, MapfoldError, MisuseError, TransportError
from eventsrc.envelope import commands
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.robot.acks import WireMessage
from eventsrc.record.transport.session import Query, Session

EDIT_PREFIX: Final = "mapfold/edit"
KNOWN_AT: Final = "known_at"


def edit_key(log_id: str) -> str:
    """The key of the queryable of the recorder that holds this log."""
    return f"{EDIT_PREFIX}/{log_id}"


class Recorded(WireMessage):
    """The command is durable at ``offset``; ``repeated`` if it was recorded before."""

    command_id: str
    offset: Offset
    repeated: bool = False


class Declined(WireMessage):
    """The command is not recorded; ``newer`` is the offset of a command that its sender did not
    know, if that is why."""

    error: str
    newer: Offset | None = None


class CommandRefused(MisuseError):
    """A recorder did not take a command; the message is the recorder's."""


class NewerCommand(MapfoldError):
    """The log has a command that the sender did not know, at ``offset``."""

    def __init__(self, offset: Offset) -> None:
        super().__init__(f"the log has a newer command, at offset {offset}; try again")
        self.offset = offset


class NoAnswer(TransportError):
    """No recorder replied: none of this log accepts commands, or the reply was lost."""


def send_command(
    session: Session, log_id: str, command: commands.Command, known_at: Offset, *, timeout_s: float
) -> Recorded:
    """Send ``command`` to the recorder of a log; return its reply when the event is durable.

    Raises CommandRefused, NewerCommand, or NoAnswer, after which the command may still be recorded.
    """
    selector = f"{edit_key(log_id)}?{KNOWN_AT}={known_at}"
    replies = session.get_replies(selector, commands.encode_command(command), timeout_s=timeout_s)
    for good, payload in replies:
        try:
            if good:
                return Recorded.decode(payload)
            declined = Declined.decode(payload)
        except ValidationError:
            continue  # Zenoh's own error, such as a timeout
        if declined.newer is not None:
            raise NewerCommand(declined.newer)
        raise CommandRefused(declined.error)
    raise NoAnswer("no recorder answered")


MAX_SELECTOR: Final = 4_096
MAX_EDITS_WAITING: Final = 64
"""Commands in the queue; more are refused at once."""

CheckCommand = Callable[[commands.Command], None]
"""Raises MapfoldError for a command that no fold could use."""


class EditRequest:
    """A command that came over Zenoh and waits for its reply. ``fault`` is why its payload is not
    read; None if its size is allowed."""

    def __init__(self, query: Query) -> None:
        self._query = query
        self.fault: str | None = None
        if query.size > commands.MAX_COMMAND_BYTES or query.selector_size > MAX_SELECTOR:
            self.fault = (
                f"a command of {query.size:,} bytes behind a selector of {query.selector_size:,}; "
                f"at most {commands.MAX_COMMAND_BYTES:,} and {MAX_SELECTOR:,} are taken"
            )
        self.payload = query.payload if self.fault is None else b""
        known_at = query.parameters.get(KNOWN_AT, "") if self.fault is None else ""
        self.known_at = Offset(int(known_at)) if known_at.isdecimal() else None

    def reply(self, recorded: Recorded) -> None:
        """Reply that the command is durable."""
        self._query.reply(self._query.key, recorded.encode())

    def refuse(self, error: str, newer: Offset | None = None) -> None:
        """Reply that the command is not recorded, and why."""
        self._query.reply_error(Declined(error=error, newer=newer).encode())


class KnownCommand(NamedTuple):
    """A command's offset and the SHA-256 of its JSON."""

    offset: Offset
    sha256: str


class KnownCommands:
    """The commands of a log by id; of two with one id, the first."""

    def __init__(self) -> None:
        self._by_id: dict[str, KnownCommand] = {}
        self.end = FIRST_OFFSET
        """The offset behind the last command."""

    @classmethod
    def of(cls, reader: LogReader) -> "KnownCommands":
        """The commands of a log. Raises LogDamaged, also for an event that is no valid command."""
        known = cls()
        for event in reader.read(keys={COMMAND_KEY}):
            try:
                command = commands.parse_command(event.payload)
            except commands.InvalidCommand as error:
                raise LogDamaged(
                    f"{reader.path}: the event at offset {event.offset} is no command: {error}"
                ) from None
            known.add(command, Offset(event.offset))
        return known

    def add(self, command: commands.Command, offset: Offset) -> None:
        """Add a command that was appended."""
        self._by_id.setdefault(command.command_id, KnownCommand(offset, _sha256(command)))
        self.end = Offset(offset + 1)

    def find(self, command: commands.Command) -> Offset | None:
        """The offset at which this command is recorded; None if its id is new. Raises
        InvalidCommand if the id is that of another command."""
        known = self._by_id.get(command.command_id)
        if known is None:
            return None
        if known.sha256 != _sha256(command):
            raise commands.InvalidCommand(
                f"command_id: {command.command_id!r} is that of another command, at offset "
                f"{known.offset}"
            )
        return known.offset


def _sha256(command: commands.Command) -> str:
    return hashlib.sha256(commands.encode_command(command)).hexdigest()


class _Waiting(NamedTuple):
    offset: Offset
    request: EditRequest
    recorded: Recorded


class Edits:
    """Appends commands to a log and replies; belongs to the writer's thread.

    ``known`` are the commands of the log, or the reason why they cannot be read: then every command
    is refused with it.
    """

    def __init__(
        self, writer: LogWriter, known: KnownCommands | str, check: CheckCommand = lambda _: None
    ) -> None:
        self._writer = writer
        self._known = known
        self._check = check
        self._waiting: deque[_Waiting] = deque()
        self.recorded = 0
        """Commands appended and durable."""

    def append(self, request: EditRequest) -> None:
        """Append a request's command, or refuse it. Raises LogError when the log cannot be
        written."""
        if isinstance(self._known, str):
            request.refuse(self._known)
            return
        try:
            command = commands.parse_command(request.payload)
            self._check(command)
            before = self._known.find(command)
        except (commands.InvalidCommand, MapfoldError) as error:
            request.refuse(str(error))
            return
        known_at = request.known_at
        if before is None and known_at is not None and known_at < self._known.end:
            newer = Offset(self._known.end - 1)
            request.refuse(f"the log has a newer command, at offset {newer}", newer)
            return
        offset = self._writer.next_offset if before is None else before
        recorded = Recorded(
            command_id=command.command_id, offset=offset, repeated=before is not None
        )
        self._waiting.append(_Waiting(offset, request, recorded))
        if before is None:
            self._writer.append(COMMAND_KEY, commands.encode_command(command))
            self._known.add(command, offset)

    def reply_to_durable(self, durable: Offset) -> None:
        """Reply to the commands before ``durable``."""
        while self._waiting and self._waiting[0].offset < durable:
            _, request, recorded = self._waiting.popleft()
            request.reply(recorded)
            self.recorded += not recorded.repeated

    def refuse_lost(self, lost: Iterable[tuple[Offset, Offset]]) -> None:
        """Refuse commands from now on: events in these ranges were lost with a file of the log, and
        commands may be among them."""
        ranges = list(lost)
        self._known = "a file of the log was lost while it was recorded; start the recorder again"
        kept = []
        for each in self._waiting:
            if any(first <= each.offset < end for first, end in ranges):
                each.request.refuse(self._known)
            else:
                kept.append(each)
        self._waiting = deque(kept)

    def refuse_all(self, error: str) -> None:
        """Refuse all commands that wait, because the log could not be written."""
        for each in self._waiting:
            each.request.refuse(f"not known to be recorded: {error}")
        self._waiting.clear()
