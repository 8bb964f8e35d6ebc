"""Commands that a new one contradicts or repeats."""

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import TypeVar

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, visible
from eventsrc.envelope import commands
from eventsrc.envelope.model import DetId, KeyframeId, RunId
from projections.fold.corrections import Keyframe, RecordedCommand
from projections.fold.pair_groups import ApartPairs
from projections.map.phrases import command_on

from .current import MapToEdit


class EditRefused(MisuseError):
    """A command is not recorded because it contradicts another one, which the message names, or
    because it would change nothing."""


def describe(recorded: RecordedCommand) -> str:
    """``command ID (keep-apart at offset 913, by user@host: reason)``."""
    command = recorded.command
    said = f": {command.reason}" if command.reason else ""
    return visible(
        f"command {command.command_id} ({command.kind} at offset {recorded.offset}, by "
        f"{command.issued_by}{said})"
    )


def refusal(what: str, recorded: RecordedCommand, log: object) -> EditRefused:
    """The refusal ``what``, with the command that causes it and how to undo that."""
    command_id = recorded.command.command_id
    return EditRefused(
        f"{what} by {describe(recorded)}; undo that first: "
        f"`{visible(advised('edit', log, 'undo', command_id, '--reason', 'WHY'))}`"
    )


def check_apart(current: MapToEdit, anchors: Iterable[Keyframe]) -> None:
    """Raises EditRefused if two of the anchors are joined by commands."""
    named = list(anchors)
    for i, first in enumerate(named):
        reached = _made_one(current.corrections.joined, first)
        for second in named[i + 1 :]:
            if (pair := reached.get(second)) is not None:
                found = command_on(current.corrections, *pair, joins=True)
                _refuse("these places are joined", found, current)


def check_join(current: MapToEdit, first: Keyframe, second: Keyframe) -> None:
    """Raises EditRefused if the places, or what is joined to them, are kept apart."""
    corrections = current.corrections
    groups = [_made_one(corrections.joined, anchor).keys() for anchor in (first, second)]
    for pair in _pairs_apart(corrections.apart, (first, second), groups, current.place_of):
        found = command_on(corrections, *pair, joins=False)
        _refuse("these places are kept apart", found, current)


_T = TypeVar("_T", bound=tuple[object, ...] | str)


def _made_one(pairs: Iterable[tuple[_T, _T]], start: _T) -> dict[_T, tuple[_T, _T] | None]:
    """All that these pairs join to ``start``, each with the first pair on the way to it."""
    of: dict[_T, list[tuple[_T, _T]]] = {}
    for pair in pairs:
        for thing in pair:
            of.setdefault(thing, []).append(pair)
    reached: dict[_T, tuple[_T, _T] | None] = {start: None}
    frontier = [start]
    while frontier:
        at = frontier.pop()
        for pair in of.get(at, ()):
            for far in pair:
                if far not in reached:
                    reached[far] = reached[at] or pair
                    frontier.append(far)
    return reached


def _pairs_apart(
    apart: ApartPairs[_T],
    two: tuple[_T, _T],
    groups: Sequence[Iterable[_T]],
    of: Callable[[_T], object],
) -> list[tuple[_T, _T]]:
    """The pairs that are apart of what is one with each of two things by commands (``groups``), and
    of what is in the place or object ``of`` each of them; ascending."""
    inside: dict[object, list[_T]] = {}
    for thing in apart.things:
        inside.setdefault(of(thing), []).append(thing)
    one, other = (inside.get(of(thing), []) for thing in two)
    return sorted({*apart.between(*groups), *apart.between(one, other)})


def _refuse(what: str, found: RecordedCommand | None, current: MapToEdit) -> None:
    if found is not None:
        raise refusal(what, found, current.reader.path)


def check_same(current: MapToEdit, first: DetId, second: DetId) -> None:
    """Raises EditRefused if the objects of two observations, or what is one with them by commands,
    are kept apart."""
    corrections = current.corrections
    groups = [_made_one(corrections.same, det_id).keys() for det_id in (first, second)]
    object_of = partial(_object, current)
    for pair in _pairs_apart(corrections.different, (first, second), groups, object_of):
        found = _objects_command(current, commands.DifferentObjects, pair)
        _refuse("these objects are kept apart", found, current)


def check_different(current: MapToEdit, first: DetId, second: DetId) -> None:
    """Raises EditRefused if the two observations are made one by commands."""
    pair = _made_one(current.corrections.same, first).get(second)
    if pair is not None:
        found = _objects_command(current, commands.SameObject, pair)
        _refuse("these objects are made one", found, current)


def _objects_command(
    current: MapToEdit,
    kind: type[commands.SameObject] | type[commands.DifferentObjects],
    pair: tuple[DetId, DetId],
) -> RecordedCommand | None:
    return _last(current, lambda c: isinstance(c, kind) and {*c.det_ids} == {*pair})


def _object(current: MapToEdit, det_id: DetId) -> object:
    found = current.observations.get(det_id)
    return det_id if found is None or found.object is None else found.object


def check_not_dropped(current: MapToEdit, det_id: DetId) -> None:
    """Raises EditRefused if the detection is left out already."""
    if det_id in current.corrections.dropped:
        found = _last(
            current,
            lambda c: (
                isinstance(c, commands.DropObject | commands.DropDetection) and det_id in c.det_ids
            ),
        )
        if found is not None:
            raise EditRefused(f"detection {det_id!r} is left out already, by {describe(found)}")


def check_run_in_map(current: MapToEdit, run_id: str) -> None:
    """Raises EditRefused if the whole run is left out already."""
    found = _last(current, lambda c: isinstance(c, commands.ForgetRun) and c.run_id == run_id)
    if found is not None:
        raise refusal(f"run {run_id!r} is left out of the map", found, current.reader.path)


def forgetting(current: MapToEdit, run_id: RunId, first: KeyframeId, last: KeyframeId) -> str:
    """``, by command …`` for keyframes that are left out already; empty if none is."""
    found = _last(
        current,
        lambda c: (
            isinstance(c, commands.ForgetKeyframes)
            and c.run_id == run_id
            and c.first <= last
            and first <= c.last
        ),
    )
    return "" if found is None else f"; some are left out already by {describe(found)}"


def _last(current: MapToEdit, holds: Callable[[commands.Command], bool]) -> RecordedCommand | None:
    in_force = reversed(current.corrections.in_force)
    return next((each for each in in_force if holds(each.command)), None)
