"""Two corrections: undo a merge of two rooms, and name one of them.

They are recorded as ``mapfold edit`` records them, and the databases are rebuilt under them.
"""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any, Final

from eventsrc.adapters.sim import SimulatedRun
from eventsrc.envelope.commands import Anchor, NamePlace, UndoMerge
from eventsrc.record.transport.session import ZenohOptions, open_session
from projections.edit.make import Stamp, name_place, undo_merge
from projections.edit.record import MakeCommand, record_command
from projections.fold.corrections import RecordedCommand
from projections.fold.settings import Settings
from projections.map.phrases import command_document
from projections.postgres import RebuildReport, rebuild
from projections.postgres.connection import Targets

from .asking import place_rooms
from .folder import DemoFolder
from .mapping import Folded, Part, fold_with_rooms, most_telling

_ISSUED_BY: Final = "demo@mapfold"


@dataclass(frozen=True, slots=True)
class Corrected:
    """The commands that were recorded, and the map under them.

    ``apart`` are the places that were one before, empty if no two were; ``named`` is the place that
    got the name of its room, None if the map has no place.
    """

    commands: tuple[RecordedCommand, ...]
    named: Part | None
    apart: tuple[Part, ...]
    folded: Folded
    replayed: RebuildReport
    seconds: float

    @property
    def same_digest(self) -> bool:
        """Whether the databases have the map that the log folds to."""
        return self.replayed.digest == self.folded.digest

    def document(self) -> dict[str, Any]:
        """As JSON, for ``mapfold demo --json``."""
        return {
            "commands": [command_document(recorded) for recorded in self.commands],
            "named": None if self.named is None else asdict(self.named),
            "apart": [asdict(part) for part in self.apart],
            "places": len(self.folded.view.places),
            "digest": self.folded.digest,
            "seconds": self.seconds,
        }


def correct(
    folder: DemoFolder, targets: Targets, settings: Settings, run: SimulatedRun, folded: Folded
) -> Corrected:
    """Undo the merge that `most_telling` returns, name the absorbed place after its room (the
    largest place if none merged), and fold again."""
    started = time.monotonic()
    commands = tuple(_record_all(folder, settings, run, folded))
    again = fold_with_rooms(folder, settings, run)
    rooms = place_rooms(again.view, run)
    named: Part | None = None
    apart: tuple[Part, ...] = ()
    for _, command in commands:
        if isinstance(command, NamePlace):
            named = _part_of(again, rooms, command.place)
        elif isinstance(command, UndoMerge):
            apart = tuple(_part_of(again, rooms, each) for each in command.places)
    replayed = rebuild(folder.log, targets, settings)
    return Corrected(commands, named, apart, again, replayed, time.monotonic() - started)


def _record_all(
    folder: DemoFolder, settings: Settings, run: SimulatedRun, folded: Folded
) -> Iterator[RecordedCommand]:
    view, rooms = folded.view, place_rooms(folded.view, run)
    if (merge := most_telling(folded.merges)) is not None:
        offset, part = merge.offset, merge.absorbed[0]
        why = "these are two rooms" if merge.across_rooms else f"two ends of the {part.room}"
        stamp = Stamp("demo-undo-merge", _ISSUED_BY, why)
        yield _record(folder, settings, stamp, lambda c, s: undo_merge(c, s, offset))
        place, room = part.place_id, part.room
    elif view.places:
        place = max(view.places.values(), key=lambda p: (p.keyframe_count, -p.ordinal)).place_id
        room = rooms[place]
    else:
        return
    stamp = Stamp("demo-name-place", _ISSUED_BY, "so that people know it")
    yield _record(folder, settings, stamp, lambda c, s: name_place(c, s, place, room))


def _record(
    folder: DemoFolder, settings: Settings, stamp: Stamp, make: MakeCommand
) -> RecordedCommand:
    made = record_command(
        folder.log,
        make,
        stamp,
        settings_of=lambda _: settings,
        open_session=lambda: open_session(ZenohOptions(), mode="client"),
    )
    assert made.offset is not None  # noqa: S101 - it was recorded
    return RecordedCommand(made.offset, made.command)


def _part_of(folded: Folded, rooms: dict[str, str], anchor: Anchor) -> Part:
    """The place that an anchor is in."""
    view = folded.view
    keyframe = next(
        k
        for k in view.keyframes
        if (k.run_id, k.keyframe_id) == (anchor.run_id, anchor.keyframe_id)
    )
    assert keyframe.place is not None  # noqa: S101 - anchors are core points
    place = view.places[keyframe.place]
    return Part(place.place_id, place.keyframe_count, rooms[place.place_id])
