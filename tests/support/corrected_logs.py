"""A log for tests of commands: two rooms that a corridor makes one place, a third far away."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from eventsrc.envelope.commands import Command, encode_command
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from projections.edit.current import CurrentMap
from projections.edit.make import Stamp
from projections.fold.settings import Settings
from tests.support.envelopes import detection, envelope
from tests.support.logs import write_log

CUP, LAMP = [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
LEFT, RIGHT, FAR = "run-a_p0", "run-a_p1", "run-b_p0"
"""The places: the first two are one since the event at `MERGE`."""
MERGE = 20
EVENTS = 30


def documents() -> list[dict[str, Any]]:
    """Fourteen keyframes in two rooms, nine in the corridor, one without a pose, one alone, and
    five of another run far away."""
    seen = {
        0: [detection("cup", CUP, det_id="cup-1")],
        1: [detection("cup", CUP, det_id="cup-2"), detection("box", det_id="bare")],
        9: [detection("cup", CUP, det_id="cup-3")],
        10: [detection("lamp", LAMP, det_id="lamp-1")],
    }
    xs = [0.5 * i for i in range(7)] + [8 + 0.5 * i for i in range(7)]
    xs += [3.5 + 0.5 * i for i in range(9)]
    found = [envelope(k, x, 0.0, detections=seen.get(k, [])) for k, x in enumerate(xs)]
    found.append(envelope(23, None))
    found.append(envelope(24, -50.0, 0.0))
    found += [envelope(k, 0.5 * k, 20.0, run_id="run-b") for k in range(5)]
    assert len(found) == EVENTS
    return found


def write_rooms(path: Path) -> Path:
    """The log of `documents`."""
    return write_log(path, documents())


def append(log: Path, command: Command) -> int:
    """Append a command as it is; returns its offset."""
    with LogWriter(log) as writer:
        return writer.append(COMMAND_KEY, encode_command(command))


def make(
    log: Path,
    function: Callable[..., Command],
    *args: Any,
    command_id: str = "new",
    settings: Settings | None = None,
) -> Command:
    """The command that a function of `projections.edit.make` makes from a log as it is."""
    with LogReader(log) as reader:
        current = CurrentMap(reader, lambda c: settings or c.settings or Settings())
        return function(current, Stamp(command_id, "me@here", "why"), *args)


def give(log: Path, function: Callable[..., Command], *args: Any, command_id: str) -> Command:
    """Make a command and append it."""
    command = make(log, function, *args, command_id=command_id)
    append(log, command)
    return command
