"""A command as a phrase and as JSON, and the one that keeps two keyframes apart or joins them."""

from typing import Any

from eventsrc.envelope.commands import Command, Join, KeepApart, UndoMerge
from projections.fold.corrections import Corrections, Keyframe, RecordedCommand


def command_name(command: Command) -> str:
    """``keep-apart c17``: its kind and id."""
    return f"{command.kind} {command.command_id}"


def command_title(command: Command) -> str:
    """``keep-apart c17 (ann@lab: two rooms)``: kind, id, author and the reason if there is one."""
    said = f"{command.issued_by}: {command.reason}" if command.reason else command.issued_by
    return f"{command_name(command)} ({said})"


def command_document(recorded: RecordedCommand) -> dict[str, Any]:
    """Offset, id, kind, author and reason as JSON."""
    command = recorded.command
    return {
        "offset": recorded.offset,
        "command_id": command.command_id,
        "kind": command.kind,
        "issued_by": command.issued_by,
        "reason": command.reason,
    }


def command_on(
    corrections: Corrections, first: Keyframe, second: Keyframe, *, joins: bool
) -> RecordedCommand | None:
    """The last command in force that joins two keyframes, or keeps them apart."""
    for recorded in reversed(corrections.in_force):
        command = recorded.command
        if isinstance(command, Join | KeepApart | UndoMerge):
            named = {(anchor.run_id, anchor.keyframe_id) for anchor in command.places}
            if isinstance(command, Join) is joins and {first, second} <= named:
                return recorded
    return None
