"""Make commands from user input and the current map.

Each function takes the current map, the `Stamp` of the command and its arguments, and returns the
command. It raises MisuseError when something does not exist (with what does), when another command
contradicts it, or when the map would not change.
"""

import re
import unicodedata
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

from pydantic import ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible
from eventsrc.envelope import commands as kinds
from eventsrc.envelope.commands import Anchor, Command
from eventsrc.envelope.model import DetId, KeyframeId, RunId, describe_error
from projections.fold.corrections import Keyframe, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.map.naming import NoSuchThing

from . import conflicts
from .current import MapToEdit

_C = TypeVar("_C", bound=Command)


class Stamp(NamedTuple):
    """The author of a command and the reason; ``command_id`` is unique in a log."""

    command_id: str
    issued_by: str
    reason: str


def build(model: type[_C], stamp: Stamp, **fields: Any) -> _C:
    """A command of this model. Raises MisuseError naming an invalid field."""
    try:
        return model(**stamp._asdict(), **fields)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "the command"
        raise MisuseError(f"{_OPTIONS.get(field, field)} {describe_error(first)}") from None


_OPTIONS = {"command_id": "--command-id", "issued_by": "--issued-by", "reason": "--reason"}


def name_place(current: MapToEdit, stamp: Stamp, place: str, name: str) -> kinds.NamePlace:
    """The command that names a place."""
    anchor = current.find_place(place)
    number = current.place_of(anchor)
    if any(unicodedata.category(character) == "Cf" for character in name):
        raise MisuseError(
            f"name '{visible(name)}' has invisible characters (category Cf); leave them out"
        )
    if any(known.place_id == name for known in current.view.all_places):
        raise MisuseError(f"{name!r} is the id of a place; give another name")
    if number is not None and current.view.all_places[number].name == name:
        raise conflicts.EditRefused(f"{current.place_name(anchor)} is called {name!r} already")
    return build(kinds.NamePlace, stamp, place=_anchor(anchor), name=name)


def keep_apart(current: MapToEdit, stamp: Stamp, first: str, second: str) -> kinds.KeepApart:
    """The command that keeps two places apart."""
    pair = _two_places(current, first, second)
    if pair in current.corrections.apart:
        raise conflicts.EditRefused(f"{first} and {second} are kept apart already")
    conflicts.check_apart(current, pair)
    return build(kinds.KeepApart, stamp, places=(_anchor(pair[0]), _anchor(pair[1])))


def undo_merge(current: MapToEdit, stamp: Stamp, offset: int) -> kinds.UndoMerge:
    """The command that keeps apart the places merged at ``offset``."""
    anchors = merged_at(current, offset)
    conflicts.check_apart(current, anchors)
    return build(
        kinds.UndoMerge, stamp, merge_offset=offset, places=tuple(_anchor(each) for each in anchors)
    )


def join(current: MapToEdit, stamp: Stamp, first: str, second: str) -> kinds.Join:
    """The command that joins two places."""
    pair = _two_places(current, first, second)
    if current.place_of(pair[0]) == current.place_of(pair[1]):
        raise conflicts.EditRefused(
            f"{first} and {second} are one place already, {current.place_name(pair[0])}"
        )
    _check_floor(f"{first} and {second}", *(current.keyframes[each].floor for each in pair))
    conflicts.check_join(current, *pair)
    return build(kinds.Join, stamp, places=(_anchor(pair[0]), _anchor(pair[1])))


def _check_floor(what: str, one: str | None, other: str | None) -> None:
    """Raise EditRefused for things on two floors, which can never be one."""
    if one != other:
        names = " and ".join("none" if name is None else repr(name) for name in (one, other))
        raise conflicts.EditRefused(
            f"{what} are on two floors, {names}; nothing on two floors is ever one"
        )


def _two_places(current: MapToEdit, first: str, second: str) -> tuple[Keyframe, Keyframe]:
    pair = current.find_place(first), current.find_place(second)
    if pair[0] == pair[1]:
        raise conflicts.EditRefused(
            f"{first} and {second} are the same place; name two, or two keyframes of it "
            f"(`{advised('merges')}` lists which places merged)"
        )
    return pair


def _anchor(keyframe: Keyframe) -> Anchor:
    return Anchor(run_id=keyframe.run_id, keyframe_id=keyframe.keyframe_id)


def same_object(current: MapToEdit, stamp: Stamp, first: str, second: str) -> kinds.SameObject:
    """The command that makes two objects one."""
    one, other = current.find_observation(first), current.find_observation(second)
    if one.object == other.object:
        raise conflicts.EditRefused(f"{first} and {second} are one object already")
    floors = (current.view.keyframes[each.keyframe].floor for each in (one, other))
    _check_floor(f"{first} and {second}", *floors)
    conflicts.check_same(current, one.det_id, other.det_id)
    is_voted = current.settings.fusion == "evidence"  # then classes of one object may differ
    if one.class_name != other.class_name and not is_voted:
        raise conflicts.EditRefused(
            f"{first} is of class {one.class_name!r}, {second} of {other.class_name!r}; only"
            " objects of one class can be one"
        )
    return build(kinds.SameObject, stamp, det_ids=(one.det_id, other.det_id))


def different_objects(
    current: MapToEdit, stamp: Stamp, first: str, second: str
) -> kinds.DifferentObjects:
    """The command that keeps two objects apart. Two observations of one object are named by their
    det_ids."""
    one, other = current.find_observation(first), current.find_observation(second)
    if one.det_id == other.det_id:
        raise conflicts.EditRefused(
            f"{first} and {second} are the same observation; name two objects, or two of the "
            f"det_ids of one (`{advised('state', '--json')}` has them)"
        )
    if (one.det_id, other.det_id) in current.corrections.different:
        raise conflicts.EditRefused(f"{first} and {second} are kept apart already")
    conflicts.check_different(current, one.det_id, other.det_id)
    return build(kinds.DifferentObjects, stamp, det_ids=(one.det_id, other.det_id))


def drop_object(current: MapToEdit, stamp: Stamp, thing: str) -> kinds.DropObject:
    """The command that leaves an object's present observations out of the map."""
    found = current.find_object(thing)
    det_ids = tuple(current.view.observations[number].det_id for number in found.observations)
    return build(kinds.DropObject, stamp, det_ids=det_ids)


def drop_detection(current: MapToEdit, stamp: Stamp, det_ids: Sequence[str]) -> kinds.DropDetection:
    """The command that leaves detections out of the map."""
    named = tuple(dict.fromkeys(map(DetId, det_ids)))
    for det_id in named:
        if det_id not in current.observations:
            conflicts.check_not_dropped(current, det_id)
            raise NoSuchThing("observation", det_id, current.observations)
    return build(kinds.DropDetection, stamp, det_ids=named)


def forget_run(current: MapToEdit, stamp: Stamp, run_id: str) -> kinds.ForgetRun:
    """The command that leaves a run out of every fold."""
    conflicts.check_run_in_map(current, run_id)
    current.run(run_id)
    return build(kinds.ForgetRun, stamp, run_id=run_id)


_RANGE = re.compile(r"(-?[0-9]{1,19})\.\.(-?[0-9]{1,19})")


def forget_keyframes(
    current: MapToEdit, stamp: Stamp, run_id: str, span: str
) -> kinds.ForgetKeyframes:
    """The command that leaves keyframes ``A..B`` of a run, both included, out of every fold."""
    found = _RANGE.fullmatch(span)
    if found is None:
        raise MisuseError(f"{span!r} is no range of keyframes; write it as 40..72")
    first, last = KeyframeId(int(found[1])), KeyframeId(int(found[2]))
    if last < first:
        raise MisuseError(f"{span}: {first} is more than {last}; write it as {last}..{first}")
    conflicts.check_run_in_map(current, run_id)
    keyframes = current.run(run_id)
    if not any(first <= k.keyframe_id <= last for k in keyframes):
        already = conflicts.forgetting(current, RunId(run_id), first, last)
        raise MisuseError(
            f"no keyframe of {run_id} in {span}{already}; {keyframes_of(current, run_id)}"
        )
    return build(kinds.ForgetKeyframes, stamp, run_id=run_id, first=first, last=last)


def keyframes_of(current: MapToEdit, run_id: str) -> str:
    """``it has 912 keyframes, 1 to 912``."""
    ids = [k.keyframe_id for k in current.run(run_id)]
    return f"it has {counted(len(ids), 'keyframe')}, {min(ids)} to {max(ids)}"


def labels_of(assignments: Sequence[str]) -> dict[str, str]:
    """The names by label of texts ``17=chair``. Raises MisuseError."""
    labels: dict[str, str] = {}
    for text in assignments:
        label, sign, name = text.partition("=")
        if not (label and sign and name):
            raise MisuseError(f"{text!r} gives no name to a label; write it as 17=chair")
        if labels.setdefault(label, name) != name:
            raise MisuseError(f"label {label!r} is given two names; give one")
    return labels


def relabel(
    current: MapToEdit,
    stamp: Stamp,
    given: Mapping[str, str],
    listed: Mapping[str, str] = MappingProxyType({}),
) -> kinds.Relabel:
    """The command that names the classes of recorded labels. The log must have each label that is
    ``given``, and one of those that are ``listed``, as all that a detector knows: the others name
    what is recorded later."""
    labels = {**listed, **given}
    named = current.corrections.labels
    if all(named.get(label, label) == name for label, name in labels.items()):
        raise conflicts.EditRefused("these labels have these names already")
    recorded = _recorded_labels(current)
    for label in given:
        if label not in recorded:
            raise _no_label(current, label, labels[label], recorded)
    found = [label for label in recorded if label in labels]
    if not found:
        label, name = next(iter(labels.items()))
        raise _no_label(current, label, name, recorded)
    later = sum(label not in recorded for label in listed)
    if later:
        of = f"{len(labels):,} labels, {', '.join(found[:_MOST_LABELS])}"
        more = len(found) - _MOST_LABELS
        rest = f" and {more:,} more" if more > 0 else ""
        current.note(
            visible(f"the log has {len(found):,} of {of}{rest}; the others name what comes later")
        )
    return build(kinds.Relabel, stamp, labels=tuple(labels.items()))


_MOST_LABELS = 10


def _recorded_labels(current: MapToEdit) -> dict[str, None]:
    """The classes as the log has them, whatever they are called now."""
    view = current.view
    if current.corrections.labels:
        others = [c for c in current.commands if not isinstance(c.command, kinds.Relabel)]
        view = current.fold(compile_corrections(others), current.settings)
    return dict.fromkeys(sorted({each.class_name for each in view.observations}))


def _no_label(
    current: MapToEdit, label: str, name: str, recorded: Mapping[str, None]
) -> MisuseError:
    """The error for a label that the log does not have, also if it is the name of one."""
    named = current.corrections.labels
    of = next((each for each in recorded if named.get(each) == label), None)
    if of is None:
        return NoSuchThing("label", label, recorded)
    return conflicts.EditRefused(
        f"{label!r} is no label, but the name of {of!r}; `{of}={name}` gives that another name"
    )


def use_settings(current: MapToEdit, stamp: Stamp, settings: Settings) -> kinds.UseSettings:
    """The command that changes the settings of the map from here on."""
    if settings == (current.corrections.settings or Settings()):
        raise conflicts.EditRefused("these are the settings of the log already")
    plain = settings.model_dump()
    return build(kinds.UseSettings, stamp, settings=plain)


def undo(current: MapToEdit, stamp: Stamp, command_id: str) -> kinds.Undo:
    """The command that undoes another one."""
    found = current.find_command(command_id)
    if found is None:
        raise NoSuchThing("command", command_id, (c.command.command_id for c in current.commands))
    by = undone_by(current.commands).get(command_id)
    if by is not None:
        raise conflicts.EditRefused(
            f"command {visible(command_id)} is undone already, by {conflicts.describe(by)}; undo"
            " that to restore it"
        )
    return build(kinds.Undo, stamp, undone=command_id)


def undone_by(commands: Sequence[RecordedCommand]) -> dict[str, RecordedCommand]:
    """The commands that are undone, by id, and the undo in force that does it."""
    by_id: dict[str, RecordedCommand] = {}
    for recorded in commands:
        by_id.setdefault(recorded.command.command_id, recorded)
    undone: dict[str, RecordedCommand] = {}
    later: set[str] = set()
    for recorded in reversed(by_id.values()):
        command = recorded.command
        later.add(command.command_id)
        in_force = command.command_id not in undone
        if isinstance(command, kinds.Undo) and in_force and command.undone not in later:
            undone.setdefault(command.undone, recorded)
    return undone


_MOST_OFFSETS = 10


def merged_at(current: MapToEdit, offset: int) -> tuple[Keyframe, ...]:
    """The founding keyframes of the places that the event at ``offset`` made one.

    Raises MisuseError with the offsets of merges when nothing merged there, and EditRefused when a
    ``join`` command merged them, or when the event made several merges.
    """
    found = [merge for merge in current.merges if merge.cause.offset == offset]
    if not found:
        _check_not_undone(current, offset)
        raise MisuseError(_nothing_merged(current, offset))
    by_themselves = [
        [merge.survivor, *(p for p in merge.absorbed if p not in merge.joined)] for merge in found
    ]
    merged = [places for places in by_themselves if len(places) > 1]
    if not merged:
        for recorded in reversed(current.corrections.in_force):
            if recorded.command.kind == "join":
                raise conflicts.refusal(
                    f"the places of the merge at {offset} are joined", recorded, current.reader.path
                )
    if len(merged) != 1:
        ids = current.view.place_id
        parts = "; ".join(" with ".join(str(ids(p)) for p in places) for places in merged)
        raise conflicts.EditRefused(
            f"{len(merged)} merges happened at offset {offset}: {parts}; say which with "
            f"`{advised('edit', current.reader.path, 'keep-apart', 'PLACE', 'PLACE')}`"
        )
    return tuple(current.founder(place) for place in merged[0])


def _check_not_undone(current: MapToEdit, offset: int) -> None:
    for recorded in current.corrections.in_force:
        command = recorded.command
        if isinstance(command, kinds.UndoMerge) and command.merge_offset == offset:
            raise conflicts.EditRefused(
                f"the merge at {offset} is undone already, by {conflicts.describe(recorded)}"
            )


def _nothing_merged(current: MapToEdit, offset: int) -> str:
    offsets = sorted(
        {m.cause.offset for m in current.merges}, key=lambda at: (abs(at - offset), at)
    )
    if not offsets:
        return f"nothing merged at offset {offset}; no places were merged in this log"
    near = ", ".join(map(str, sorted(offsets[:_MOST_OFFSETS])))
    more = len(offsets) - _MOST_OFFSETS
    rest = f" (and {more:,} more)" if more > 0 else ""
    return (
        f"nothing merged at offset {offset}; {counted(len(offsets), 'event')} merged places, at "
        f"{near}{rest}: see `{advised('merges', current.reader.path)}`"
    )
