"""What comes of a command: found by folding the log with it, before it is recorded.

A command that no fold can obey, or that would not do what it says, is refused. An undo may be
recorded where the map cannot be folded without it either: it may be a step on the way out.
"""

from collections.abc import Iterator
from itertools import combinations
from math import sqrt
from typing import NamedTuple

from eventsrc.commands import (
    Command,
    CorrectPoses,
    DifferentObjects,
    Join,
    KeepApart,
    SameObject,
    UndoMerge,
)
from eventsrc.errors import LogError
from projections.corrections import RecordedCommand
from projections.errors import FoldError

from .conflicts import EditRefused, describe
from .current import CurrentMap
from .effect import Change, Effect
from .located import Located, name_of


class Outcome(NamedTuple):
    """``effect`` is None if it cannot be worked out, ``unknown`` then says why; ``void`` are the
    commands that have no effect any more, and why."""

    change: Change
    effect: Effect | None
    unknown: str = ""
    void: tuple[tuple[RecordedCommand, str], ...] = ()


def outcome_of(current: CurrentMap, command: Command, *, recorded: bool) -> Outcome:
    """What comes of a command. One that is not ``recorded`` is refused with EditRefused if the map
    cannot be folded with it but without it, or if it would not do what it says."""
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
    """Whether the map can be folded without the command and not with it."""
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
                        f"(`mapfold merges {current.reader.path}`) or keyframes that founded two"
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
