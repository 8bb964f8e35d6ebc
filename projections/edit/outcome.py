"""The effect of a command, found by folding the log with it before it is recorded.

A command that no fold can obey, or that would not have its effect, is refused. An undo may be
recorded even if the map cannot be folded with it: it may be the first of several undos that are
needed.
"""

from collections.abc import Iterator
from itertools import combinations
from math import sqrt
from typing import NamedTuple

from eventsrc.base.advised import advised
from eventsrc.base.errors import LogError
from eventsrc.envelope.commands import (
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
from eventsrc.envelope.model import DetId
from projections.fold.corrections import Keyframe, RecordedCommand
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.errors import FoldError
from projections.map.view import MapView

from .conflicts import EditRefused, describe
from .current import CurrentMap
from .effect import Change, Effect


class Outcome(NamedTuple):
    """``effect`` is None if it cannot be computed, ``unknown`` is then the reason; ``void`` are the
    commands that have no effect any more, with reasons."""

    change: Change
    effect: Effect | None
    unknown: str = ""
    void: tuple[tuple[RecordedCommand, str], ...] = ()


def outcome_of(current: CurrentMap, command: Command, *, recorded: bool) -> Outcome:
    """The outcome of a command. One that is not ``recorded`` is refused with EditRefused if the map
    can be folded without it but not with it, or if it would not have its effect."""
    change = Change.by(current, command)
    try:
        effect = change.effect()
    except (FoldError, LogError) as error:
        if not recorded and _is_the_cause(change):
            raise EditRefused(
                f"{command.kind} is not recorded, because the map cannot be folded with it: {error}"
            ) from None
        return Outcome(change, None, str(error))
    if recorded:
        return Outcome(change, effect)
    _check_does(change, command, effect)
    return Outcome(change, effect, void=tuple(_void(change)))


def _is_the_cause(change: Change) -> bool:
    """Whether the map can be folded without the command but not with it."""
    try:
        _ = change.current.view
    except (FoldError, LogError):
        return False
    return True


def _check_does(change: Change, command: Command, effect: Effect) -> None:
    current = change.current
    match command:
        case KeepApart() | UndoMerge():
            located = Located.of(change.after)
            for first, second in combinations(command.places, 2):
                place = located.place(first)
                if place is not None and place == located.place(second):
                    side = change.settings.eps_m / sqrt(2.0)
                    raise EditRefused(
                        f"{command.kind} would not part {name_of(first)} and {name_of(second)}: "
                        f"both would be in {change.after.place_id(place)}; keyframes in a cell of "
                        f"side ε/√2 = {side:.3g} m are never parted, nor those whose places were "
                        "one before the later of them came; name two places that were merged "
                        f"(`{advised('merges', current.reader.path)}`) or keyframes that founded "
                        "two"
                    )
        case DifferentObjects():
            located = Located.of(change.after)
            one, other = map(located.object, command.det_ids)
            if one is not None and one == other:
                raise EditRefused(
                    f"different-objects would not part {command.det_ids[0]!r} and "
                    f"{command.det_ids[1]!r}: both would be of one object still; name the "
                    "det_ids that founded two objects"
                )
        case Join() | SameObject() | CorrectPoses() if effect.none:
            raise EditRefused(f"{command.kind} would change nothing in the map; it is not recorded")
        case _:
            pass


def _void(change: Change) -> Iterator[tuple[RecordedCommand, str]]:
    """The commands in force before and after that have an effect before and none after."""
    if change.known_after is None or change.known_after is change.current.view:
        return
    still = {each.offset for each in change.corrections.in_force}
    given = [r for r in change.current.corrections.in_force if r.offset in still]
    if not given:
        return
    before, after = Located.of(change.current.view), Located.of(change.known_after)
    for recorded in given:
        why = after.why_void(recorded.command)
        if why and not before.why_void(recorded.command):
            yield recorded, why


def void_text(recorded: RecordedCommand, why: str) -> str:
    """``command ID (…) has no effect any more: its keyframe run:4 is left out``."""
    return f"{describe(recorded)} has no effect any more: {why}"


class Located(NamedTuple):
    """The place of every keyframe of a map and the object of every observation; None for none."""

    keyframes: dict[Keyframe, PlaceOrdinal | None]
    observations: dict[DetId, ObjectOrdinal | None]

    @classmethod
    def of(cls, view: MapView) -> "Located":
        """The places and objects of a map."""
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
