"""Append commands to logs in tests, as `mapfold edit` would."""

from itertools import count
from pathlib import Path
from typing import Any

from eventsrc.envelope import commands
from eventsrc.envelope.commands import Anchor, Command, encode_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import NEVER, LogWriter

_numbers = count()


def command(kind: type[Any], **values: Any) -> Command:
    """A command with an id of its own."""
    made: Command = kind(command_id=f"c{next(_numbers)}", issued_by="ann@lab", **values)
    return made


def append_command(log: Path, given: Command) -> int:
    """Append a command; its offset."""
    with LogWriter(log, fsync=NEVER) as writer:
        return append_to(writer, given)


def append_to(writer: LogWriter, given: Command) -> int:
    """Append a command with an open writer; its offset. Logged as `logs.write_log` does."""
    logged_ns = (writer.next_offset + 1) * 1_000_000_000 + 123_456_789
    return int(writer.append(COMMAND_KEY, encode_command(given), logged_ns=logged_ns))


def name_place(keyframe_id: int, name: str, run_id: str = "run-a") -> Command:
    """Names the place of a keyframe."""
    return command(commands.NamePlace, place=anchor(keyframe_id, run_id), name=name)


def keep_apart(first: int, second: int, run_id: str = "run-a") -> Command:
    """Keeps the places of two keyframes of a run apart."""
    return command(commands.KeepApart, places=(anchor(first, run_id), anchor(second, run_id)))


def forget_keyframes(first: int, last: int, run_id: str = "run-a") -> Command:
    """Leaves keyframes of a run out."""
    return command(commands.ForgetKeyframes, run_id=run_id, first=first, last=last)


def forget_run(run_id: str) -> Command:
    """Leaves a run out."""
    return command(commands.ForgetRun, run_id=run_id)


def undo(undone: Command) -> Command:
    """Undoes a command."""
    return command(commands.Undo, undone=undone.command_id)


def anchor(keyframe_id: int, run_id: str = "run-a") -> Anchor:
    """A keyframe that stands for its place."""
    return Anchor(run_id=run_id, keyframe_id=keyframe_id)  # type: ignore[arg-type]
