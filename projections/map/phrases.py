"""Commands as phrases and as JSON, the changes of an event as lines of text, and times."""

from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from typing import Any

from eventsrc.base.text import visible
from eventsrc.envelope.commands import Command, Join, KeepApart, UndoMerge
from projections.fold import deltas as d
from projections.fold.corrections import Corrections, Keyframe, RecordedCommand
from projections.fold.exact import UM_PER_M

from .view import MapView


def iso_time(time_s: float) -> str:
    """Robot seconds since the epoch as ISO 8601 UTC with milliseconds, ending in Z."""
    moment = datetime.fromtimestamp(time_s, UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def seen_times(first_seen: float, last_seen: float) -> dict[str, Any]:
    """When a thing was first and last seen, as seconds since the epoch and as ISO 8601."""
    return {
        "first_seen": first_seen,
        "last_seen": last_seen,
        "first_seen_iso": iso_time(first_seen),
        "last_seen_iso": iso_time(last_seen),
    }


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


def change_lines(view: MapView, deltas: Iterable[d.Delta]) -> Iterator[str]:
    """A line for each change of a place, an object's identity or a map; ``view`` has the deltas
    applied."""

    def place(ordinal: d.PlaceOrdinal) -> str:
        return view.all_places[ordinal].place_id

    def thing(ordinal: d.ObjectOrdinal) -> str:
        found = view.all_objects[ordinal]
        return f"{visible(found.class_name)} {found.object_id}"

    for delta in deltas:
        match delta:
            case d.FrameJoined():
                into = "the map's frame" if delta.into is None else f"frame {visible(delta.into)}"
                yield f"frame {visible(delta.frame)} joined into {into} by a command"
            case d.PlaceFormed():
                yield f"place {delta.place_id} founded"
            case d.PlacesMerged():
                bridge = view.keyframes[delta.bridge]
                absorbed = ", ".join(map(place, delta.absorbed))
                yield (
                    f"place {absorbed} merged into {place(delta.survivor)}"
                    f" by {visible(bridge.run_id)}:{bridge.keyframe_id}"
                )
            case d.MergeRefused():
                yield f"places {place(delta.a)} and {place(delta.b)} kept apart by a command"
            case d.PlaceNamed():
                named = "has no name" if delta.name is None else f"is called {visible(delta.name)}"
                yield f"place {place(delta.place)} {named}"
            case d.ObjectFound():
                yield f"object {thing(delta.object)} found"
            case d.ObjectsMerged():
                yield f"object {thing(delta.absorbed)} merged into {thing(delta.survivor)}"
            case d.ObjectMissing(missing=True):
                yield f"object {thing(delta.object)} missing after {delta.misses} misses"
            case d.ObjectRelocated():
                x, y = delta.to_x_um / UM_PER_M, delta.to_y_um / UM_PER_M
                yield f"object {thing(delta.object)} relocated to ({x:.2f}, {y:.2f})"
            case d.MapGiven():
                yield f"occupancy map of {delta.map.width} × {delta.map.height} cells given"
            case _:
                pass
