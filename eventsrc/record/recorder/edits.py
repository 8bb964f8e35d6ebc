"""Send commands over Zenoh to the recorder that holds a log: the query and its replies.

A recorder started with ``--accept-edits`` answers queries to ``mapfold/edit/<log id>``. The payload
is a command's JSON (`eventsrc.envelope.commands`). The parameter ``known_at=N`` says that the
sender made the command knowing all commands before offset N; if the log has a later one, the
command is not recorded, so that a map that has changed meanwhile is not edited. Without it the
command is recorded whatever came before.

The reply is a `Recorded`, sent when the event is durable. A command whose ``command_id`` the log
has is not recorded again; the reply then names the offset that it has. An error reply is a
`Refused`.
"""

from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from eventsrc.base.errors import MapfoldError, MisuseError, TransportError
from eventsrc.envelope.commands import Command, encode_command
from eventsrc.envelope.model import Offset
from eventsrc.record.transport.session import Session

EDIT_PREFIX: Final = "mapfold/edit"
KNOWN_AT: Final = "known_at"


def edit_key(log_id: str) -> str:
    """The key of the queryable of the recorder that holds this log."""
    return f"{EDIT_PREFIX}/{log_id}"


class _Model(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore")

    def encode(self) -> bytes:
        """The bytes that go over the wire."""
        return self.model_dump_json().encode()


class Recorded(_Model):
    """The command is durable at ``offset``; ``repeated`` if it was recorded before."""

    command_id: str
    offset: Offset
    repeated: bool = False


class Refused(_Model):
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
    session: Session, log_id: str, command: Command, known_at: Offset, *, timeout_s: float
) -> Recorded:
    """Send ``command`` to the recorder of a log; return its reply when the event is durable.

    Raises CommandRefused, NewerCommand, or NoAnswer, after which the command may still be recorded.
    """
    selector = f"{edit_key(log_id)}?{KNOWN_AT}={known_at}"
    replies = session.get_replies(selector, encode_command(command), timeout_s=timeout_s)
    for good, payload in replies:
        try:
            if good:
                return Recorded.model_validate_json(payload)
            refused = Refused.model_validate_json(payload)
        except ValidationError:
            continue  # Zenoh's own error, such as a timeout
        if refused.newer is not None:
            raise NewerCommand(refused.newer)
        raise CommandRefused(refused.error)
    raise NoAnswer("no recorder answered")
