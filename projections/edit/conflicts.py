"""Commands that stand in the way of a new one: contradictions, and repetitions."""

from collections.abc import Callable, Iterable

from eventsrc.commands import (
    Command,
    DifferentObjects,
    DropDetection,
    DropObject,
    ForgetKeyframes,
    ForgetRun,
    SameObject,
)
from eventsrc.envelope import DetId, KeyframeId, RunId
from eventsrc.errors import MisuseError
from eventsrc.text import visible
from projections.corrections import Keyframe, RecordedCommand
from projections.model.command_text import command_on

from .current import CurrentMap


class EditRefused(MisuseError):
    """A command is not recorded because of another one, which the message names, or because it
    would change nothing."""


def describe(recorded: RecordedCommand) -> str:
    """``command ID (keep-apart at offset 913, by user@host: reason)``."""
    command = recorded.command
    said = f": {command.reason}" if command.reason else ""
    return visible(
        f"command {command.command_id} ({command.kind} at offset {recorded.offset}, by "
        f"{command.issued_by}{said})"
    )


def refusal(what: str, recorded: RecordedCommand, log: object) -> EditRefused:
    """``what``, by which command, and how to undo that."""
    command_id = visible(recorded.command.command_id)
    return EditRefused(
        f"{what} by {describe(recorded)}; undo that first: `mapfold edit {visible(str(log))} undo "
        f"{command_id} --reason …`"
    )


def check_apart(current: CurrentMap, anchors: Iterable[Keyframe]) -> None:
    """Raises EditRefused if two of the anchors are joined by commands."""
    named = list(anchors)
    for i, first in enumerate(named):
        for second in named[i + 1 :]:
            found = _joining(current, first, second)
            if found is not None:
                raise refusal("these places are joined", found, current.reader.path)


def check_join(current: CurrentMap, first: Keyframe, second: Keyframe) -> None:
    """Raises EditRefused if the places hold anchors that are kept apart."""
    wanted = {current.place_of(first), current.place_of(second)}
    for pair in current.corrections.apart:
        if {*pair} == {first, second} or {current.place_of(k) for k in pair} == wanted:
            found = command_on(current.corrections, *pair, joins=False)
            if found is not None:
                raise refusal("these places are kept apart", found, current.reader.path)


def _joining(current: CurrentMap, first: Keyframe, second: Keyframe) -> RecordedCommand | None:
    """The first join on a way of joins from one anchor to another; keyframes that were put into one
    place first are one step."""

    def spot(keyframe: Keyframe) -> object:
        place = current.original_place_of(keyframe)
        return keyframe if place is None else place

    reached: dict[object, RecordedCommand | None] = {spot(first): None}
    frontier = [spot(first)]
    while frontier:
        at = frontier.pop()
        for a, b in current.corrections.joined:
            for near, far in ((spot(a), spot(b)), (spot(b), spot(a))):
                if near == at and far not in reached:
                    reached[far] = reached[at] or command_on(current.corrections, a, b, joins=True)
                    frontier.append(far)
    return reached.get(spot(second))


def check_same(current: CurrentMap, first: DetId, second: DetId) -> None:
    """Raises EditRefused if the two observations are of objects that are kept apart."""
    wanted = {_object(current, first), _object(current, second)}
    for pair in current.corrections.different:
        if {*pair} == {first, second} or {_object(current, d) for d in pair} == wanted:
            found = _objects_command(current, DifferentObjects, pair)
            if found is not None:
                raise refusal("these objects are kept apart", found, current.reader.path)


def check_different(current: CurrentMap, first: DetId, second: DetId) -> None:
    """Raises EditRefused if the two observations are made one by commands."""
    reached, frontier = {first}, [first]
    by: RecordedCommand | None = None
    while frontier:
        at = frontier.pop()
        for pair in current.corrections.same:
            if at in pair:
                by = by or _objects_command(current, SameObject, pair)
                more = {*pair} - reached
                reached |= more
                frontier += more
    if second in reached and by is not None:
        raise refusal("these objects are made one", by, current.reader.path)


def _objects_command(
    current: CurrentMap,
    kind: type[SameObject] | type[DifferentObjects],
    pair: tuple[DetId, DetId],
) -> RecordedCommand | None:
    return _last(current, lambda c: isinstance(c, kind) and {*c.det_ids} == {*pair})


def _object(current: CurrentMap, det_id: DetId) -> object:
    found = current.observations.get(det_id)
    return det_id if found is None or found.object is None else found.object


def check_not_dropped(current: CurrentMap, det_id: DetId) -> None:
    """Raises EditRefused if the detection is left out already."""
    if det_id in current.corrections.dropped:
        found = _last(
            current,
            lambda c: isinstance(c, DropObject | DropDetection) and det_id in c.det_ids,
        )
        if found is not None:
            raise EditRefused(f"detection {det_id!r} is left out already, by {describe(found)}")


def check_run_in_map(current: CurrentMap, run_id: str) -> None:
    """Raises EditRefused if the whole run is left out already."""
    found = _last(current, lambda c: isinstance(c, ForgetRun) and c.run_id == run_id)
    if found is not None:
        raise refusal(f"run {run_id!r} is left out of the map", found, current.reader.path)


def forgetting(current: CurrentMap, run_id: RunId, first: KeyframeId, last: KeyframeId) -> str:
    """``, by command …`` for keyframes that are left out already; empty if none is."""
    found = _last(
        current,
        lambda c: (
            isinstance(c, ForgetKeyframes)
            and c.run_id == run_id
            and c.first <= last
            and first <= c.last
        ),
    )
    return "" if found is None else f"; some are left out already by {describe(found)}"


def _last(current: CurrentMap, holds: Callable[[Command], bool]) -> RecordedCommand | None:
    in_force = reversed(current.corrections.in_force)
    return next((each for each in in_force if holds(each.command)), None)
