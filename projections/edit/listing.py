"""The list of a log's commands, as text and as JSON."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from eventsrc.base.advised import advised
from eventsrc.base.text import counted, table, visible
from eventsrc.envelope.commands import (
    Command,
    CorrectPoses,
    DifferentObjects,
    DropDetection,
    DropObject,
    ForgetKeyframes,
    ForgetRun,
    Join,
    KeepApart,
    NamePlace,
    Reembed,
    SameObject,
    Undo,
    UndoMerge,
    UseSettings,
)
from eventsrc.envelope.model import Offset
from projections.fold.corrections import RecordedCommand
from projections.fold.settings import Settings, assignment_texts, settings_by_name
from projections.map.phrases import command_document
from projections.store.history_records import iso_time

from .effect import Effect
from .make import undone_by

Found = Sequence[tuple[RecordedCommand, Effect | None]]


def what(command: Command) -> str:
    """A short description of a command's subject."""
    match command:
        case NamePlace():
            return f"{_name(command.place)} is {command.name}"
        case KeepApart() | Join():
            return " and ".join(map(_name, command.places))
        case UndoMerge():
            return f"at {command.merge_offset}: {' and '.join(map(_name, command.places))}"
        case SameObject() | DifferentObjects():
            return " and ".join(command.det_ids)
        case DropObject() | DropDetection():
            more = len(command.det_ids) - 1
            return command.det_ids[0] + (f" and {more:,} more" if more else "")
        case ForgetRun():
            return command.run_id
        case ForgetKeyframes():
            return f"{command.run_id}:{command.first}..{command.last}"
        case CorrectPoses():
            return f"{command.run_id}: {_poses(command)}"
        case UseSettings():
            plain, given = _default_settings(), settings_by_name(command.settings)
            changed = {name: value for name, value in given.items() if plain.get(name) != value}
            return ", ".join(assignment_texts(changed)) or "the defaults"
        case Reembed():
            return f"{counted(command.detections, 'detection')} in {command.space}"
        case Undo():
            return command.undone


@cache
def _default_settings() -> Mapping[str, Any]:
    return Settings().by_name()


def _name(anchor: Any) -> str:
    return f"{anchor.run_id}:{anchor.keyframe_id}"


def _poses(command: CorrectPoses) -> str:
    if command.transform is None:
        return counted(len(command.poses), "pose")
    t = command.transform
    span = ""
    if command.first is not None or command.last is not None:
        first = "" if command.first is None else command.first
        span = f" of {first}..{'' if command.last is None else command.last}"
    return f"dx={t.dx:g} dy={t.dy:g} dyaw={t.dyaw:g}{span}"


def edits_text(found: Found, times: Mapping[Offset, int]) -> str:
    """A table of the commands, two lines for each, and what to do next."""
    if not found:
        return f"no command in this log; `{advised('edit')}` records one\n"
    undone = undone_by([recorded for recorded, _ in found])
    first_of = _first_offsets(found)
    rows = []
    for (offset, command), effect in found:
        by = undone.get(command.command_id)
        state = "" if by is None else f"undone by {visible(by.command.command_id)}"
        if (first := first_of[command.command_id]) != offset:
            state = f"not counted: its id is that of {first}"
        rows.append(
            [
                str(offset),
                iso_time(times[offset] / 1e9),
                visible(command.issued_by),
                f"{command.kind} {visible(what(command))}",
                "not computed" if effect is None else str(effect),
                visible(command.command_id),
                state,
                visible(command.reason),
            ]
        )
    header = ("offset", "time", "by", "command", "changed", "command id", "undone", "reason")
    text = table(header, rows, right={"offset"})
    if any(effect is None for _, effect in found):
        text += "--effects computes the missing ones\n"
    return text


def edits_document(found: Found, times: Mapping[Offset, int]) -> list[dict[str, Any]]:
    """JSON: an object for each command, in order of offset. One whose command_id an earlier one has
    does not count, and has that one's offset as ``repeats``."""
    first_of = _first_offsets(found)
    undone = undone_by([recorded for recorded, _ in found])
    return [
        {
            **command_document(recorded),
            "time": iso_time(times[recorded.offset] / 1e9),
            "what": what(recorded.command),
            "effect": None if effect is None else effect.document(),
            "undone_by": _id_of(undone.get(recorded.command.command_id)),
            **_repeats(first_of[recorded.command.command_id], recorded.offset),
        }
        for recorded, effect in found
    ]


def _id_of(recorded: RecordedCommand | None) -> str | None:
    return None if recorded is None else recorded.command.command_id


def _first_offsets(found: Found) -> dict[str, Offset]:
    """The offset of the command that counts, for each command_id."""
    first: dict[str, Offset] = {}
    for recorded, _ in found:
        first.setdefault(recorded.command.command_id, recorded.offset)
    return first


def _repeats(first: Offset, offset: Offset) -> dict[str, Offset]:
    return {} if first == offset else {"repeats": first}
