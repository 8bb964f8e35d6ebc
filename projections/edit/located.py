"""Where the things that commands name are in a map, and whether a command has any effect there."""

from typing import NamedTuple

from eventsrc.commands import (
    Anchor,
    Command,
    CorrectPoses,
    DifferentObjects,
    Join,
    KeepApart,
    NamePlace,
    SameObject,
    UndoMerge,
)
from eventsrc.envelope import DetId
from projections.corrections import Keyframe
from projections.deltas import ObjectOrdinal, PlaceOrdinal
from projections.model.view import MapView


class Located(NamedTuple):
    """The place of every keyframe of a map and the object of every observation; None for none."""

    keyframes: dict[Keyframe, PlaceOrdinal | None]
    observations: dict[DetId, ObjectOrdinal | None]

    @classmethod
    def of(cls, view: MapView) -> "Located":
        """Of a map."""
        return cls(
            {Keyframe(k.run_id, k.keyframe_id): k.place for k in view.keyframes},
            {o.det_id: o.object for o in view.observations},
        )

    def place(self, anchor: Anchor) -> PlaceOrdinal | None:
        """The place of an anchor."""
        return self.keyframes.get(_keyframe(anchor))

    def object(self, det_id: DetId) -> ObjectOrdinal | None:
        """The object of an observation."""
        return self.observations.get(det_id)

    def why_void(self, command: Command) -> str:
        """Why a command has no effect in this map; empty if it may have one."""
        match command:
            case NamePlace():
                return self._not_placed((command.place,), 1)
            case KeepApart() | Join() | UndoMerge():
                why = self._not_placed(command.places, 2)
                if why or isinstance(command, Join):
                    return why
                places = {self.place(a) for a in command.places} - {None}
                return "" if len(places) > 1 else "what it keeps apart is one place"
            case SameObject() | DifferentObjects():
                for det_id in command.det_ids:
                    if det_id not in self.observations:
                        return f"its detection {det_id!r} is left out"
                    if self.object(det_id) is None:
                        return f"its detection {det_id!r} is of no object"
                if isinstance(command, SameObject):
                    return ""
                one, other = map(self.object, command.det_ids)
                return "what it keeps apart is one object" if one == other else ""
            case CorrectPoses():
                there = any(k.run_id == command.run_id for k in self.keyframes)
                return "" if there else f"its run {command.run_id!r} is left out"
            case _:
                return ""

    def _not_placed(self, anchors: tuple[Anchor, ...], least: int) -> str:
        """Why fewer than ``least`` anchors are in a place; empty if so many are."""
        if sum(self.place(anchor) is not None for anchor in anchors) >= least:
            return ""
        lost = next(anchor for anchor in anchors if self.place(anchor) is None)
        is_there = _keyframe(lost) in self.keyframes
        return f"its keyframe {name_of(lost)} is {'in no place' if is_there else 'left out'}"


def name_of(anchor: Anchor) -> str:
    """``run:keyframe``."""
    return f"{anchor.run_id}:{anchor.keyframe_id}"


def _keyframe(anchor: Anchor) -> Keyframe:
    return Keyframe(anchor.run_id, anchor.keyframe_id)
