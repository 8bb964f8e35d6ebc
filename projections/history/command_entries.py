"""Entries of an explanation for the commands about a place, an object or two keyframes.

A command names keyframes and det_ids. It is about a place if a keyframe that it names is in that
place, and about an object if a detection that it names is one of the object's.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope import commands
from eventsrc.envelope.model import FIRST_OFFSET, KeyframeId, Offset, RunId
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader
from projections.fold.corrections import Keyframe, RecordedCommand
from projections.fold.deltas import KeyframeOrdinal, PlaceOrdinal
from projections.fold.pose_corrections import PoseCorrection
from projections.map.phrases import command_document, command_name, command_title
from projections.store.history import History
from projections.store.history_records import Cause, PlaceHistory, RefusedMerge

from .explanation import Entry
from .merge_reasons import refusal_reason
from .names import log_name, place_name

_NS = 1e9


class EntryMaker:
    """Makes the entries of recorded commands, with the times of their events."""

    def __init__(self, reader: LogReader) -> None:
        self._reader = reader
        self._stamps_ns: dict[Offset, int] = {}
        self._read_to = FIRST_OFFSET

    def cause(self, recorded: RecordedCommand) -> Cause:
        """The event of a command; the times of all commands up to it are read together, once."""
        offset = recorded.offset
        if offset >= self._read_to:
            end = Offset(offset + 1)
            for event in self._reader.read(self._read_to, end, keys=(COMMAND_KEY,)):
                self._stamps_ns[event.offset] = event.stamp_ns
            self._read_to = end
        name = command_name(recorded.command)
        return Cause(offset, "command", self._stamps_ns[offset] / _NS, what=name)

    def entry(self, recorded: RecordedCommand, text: str, **facts: Any) -> Entry:
        """An entry: ``text`` (what the command did), its kind and id, its author and its reason."""
        command = recorded.command
        document = {"command": command_document(recorded), **facts}
        by = f"{text} by {command_title(command)}"
        return Entry(self.cause(recorded), command.kind, by, document)


def place_commands(
    maker: EntryMaker, history: History, record: PlaceHistory, end: Offset
) -> list[Entry]:
    """Commands that named, kept apart, joined or moved something of a place, and the merges of it
    that they refused, after the events below ``end``."""
    place, moment = record.formed.place, _last_moment(record, end)
    members: dict[RunId, set[KeyframeId]] = {}
    if history.corrections.poses or history.corrections.frames:
        for keyframe in history.keyframes:
            if history.place_at(keyframe.keyframe, moment) == place:
                members.setdefault(keyframe.run_id, set()).add(keyframe.keyframe_id)
    texts = [
        (recorded, text)
        for recorded in history.corrections.in_force
        for text in _place_texts(history, recorded, place, members, moment, end)
    ]
    entries = [maker.entry(*each) for each in reversed(texts)][::-1]  # the last one reads all times
    refused = (r for r in history.refusals if r.cause.offset < end and place in (r.a, r.b))
    return [*entries, *(_refusal_entry(history, refusal, place) for refusal in refused)]


def _last_moment(record: PlaceHistory, end: Offset) -> Offset:
    """The greatest number of events, at most ``end``, after which the place stood."""
    merge = record.absorbed_by
    return end if merge is None else min(end, merge.cause.offset)


def _place_texts(
    history: History,
    recorded: RecordedCommand,
    place: PlaceOrdinal,
    members: Mapping[RunId, Collection[KeyframeId]],
    moment: Offset,
    end: Offset,
) -> Iterator[str]:
    """What a command did to a place as it is after ``moment`` events; joins are judged after
    ``end``."""
    command = recorded.command
    match command:
        case commands.NamePlace() if _place_of(history, command.place, moment) == place:
            replaced = history.places[place].name(moment) != command.name
            yield f'named "{command.name}"' + (" until a later name," if replaced else "")
        case commands.KeepApart() | commands.UndoMerge():
            own, others = _divided(history, command.places, place, moment)
            if own:
                yield _apart_text(history, own, others, moment)
        case commands.Join():
            own, others = _divided(history, command.places, place, moment)
            if own:
                yield _join_text(history, command, end)
        case commands.CorrectPoses():
            moved = _moved(command, members.get(command.run_id, ()))
            if moved:
                yield f"{counted(moved, 'keyframe')} of it moved"
        case commands.JoinFrames():
            moved = sum(
                history.keyframes[history.keyframe_ordinals[run, each]].frame == command.frame
                for run, ids in members.items()
                for each in ids
            )
            if moved:
                yield f"{counted(moved, 'keyframe')} of it moved with their frame"


def _apart_text(
    history: History, own: Sequence[commands.Anchor], others: Sequence[commands.Anchor], end: Offset
) -> str:
    """The text of a command that keeps anchors apart; ``own`` are in the explained place."""
    if others:
        text = f"kept apart from {_named(history, others, end)}"
        if not _are_apart(history, own, others):
            return f"{text} until a later join,"
        if all(_place_of(history, anchor, end) is None for anchor in others):
            return f"{text}, without effect here as that is in no place,"
        return text
    text = f"{_both(own)} kept apart"
    if len(set(own)) < 2:
        return f"{text}, without effect as they are one keyframe,"
    if not _are_apart(history, own, own):
        return f"{text} until a later join,"
    return f"{text}, without effect here as no command divides a cell of core points,"


def _join_text(history: History, command: commands.Join, end: Offset) -> str:
    """The text of a join of anchors, with its effect after ``end`` events."""
    one, other = command.places
    text = f"joined {_both(command.places)}"
    if one == other:
        return f"{text}, without effect as they are one keyframe,"
    if tuple(sorted(map(_keyframe, command.places))) not in history.corrections.joined:
        return f"{text} until a later keep-apart,"
    places = {_place_of(history, anchor, end) for anchor in command.places}
    if None in places:
        return f"{text}, without effect here as one of them is in no place,"
    if len(places) > 1:
        return f"{text}, without effect here as their places are kept apart,"
    return text


def _both(anchors: Sequence[commands.Anchor]) -> str:
    return " and ".join(f"{anchor.run_id}:{anchor.keyframe_id}" for anchor in anchors)


def object_commands(
    maker: EntryMaker, history: History, det_ids: Iterable[str], class_name: str
) -> list[Entry]:
    """Commands that fuse or keep apart detections of an object, or gave its class the name."""
    own = set(det_ids)
    entries = []
    for recorded in history.corrections.in_force:
        command = recorded.command
        if isinstance(command, commands.SameObject | commands.DifferentObjects) and own & set(
            command.det_ids
        ):
            word = "fused" if isinstance(command, commands.SameObject) else "kept apart"
            entries.append(maker.entry(recorded, f"{word} {' and '.join(command.det_ids)}"))
        elif isinstance(command, commands.Relabel):
            labels = history.corrections.labels
            given = [a for a, b in command.labels if b == class_name == labels[a] != a]
            if given:
                text = f"label {' and '.join(given)} called {class_name}"
                entries.append(maker.entry(recorded, text))
    return entries


def same_place_commands(
    maker: EntryMaker,
    history: History,
    keyframes: tuple[KeyframeOrdinal, KeyframeOrdinal],
    end: Offset,
) -> list[Entry]:
    """Commands that join the places of two keyframes or keep them apart, and the merges of the two
    places that they refused, after the events below ``end``."""
    first, second = (history.place_at(k, end) for k in keyframes)
    asked = {log_name(history, k) for k in keyframes}
    entries = []
    for recorded in history.corrections.in_force:
        command = recorded.command
        if not isinstance(command, commands.KeepApart | commands.UndoMerge | commands.Join):
            continue
        names = {_keyframe(anchor) for anchor in command.places}
        places = {_place_of(history, anchor, end) for anchor in command.places} - {None}
        if isinstance(command, commands.Join):
            if asked <= names or (first == second and places == {first}):
                entries.append(maker.entry(recorded, "joined"))
        elif asked <= names or (first != second and {first, second} <= places):
            entries.append(maker.entry(recorded, "kept apart"))
    return entries + [
        _refusal_entry(history, refusal, None)
        for refusal in history.refusals
        if refusal.cause.offset < end and {refusal.a, refusal.b} == {first, second}
    ]


def _refusal_entry(history: History, refusal: RefusedMerge, place: PlaceOrdinal | None) -> Entry:
    if place is None:
        what = f"merge of {place_name(history, refusal.a)} and {place_name(history, refusal.b)}"
    else:
        other = refusal.b if place == refusal.a else refusal.a
        what = f"merge with {place_name(history, other)}"
    return Entry(
        refusal.cause,
        "refused",
        f"{what} refused; {refusal_reason(history, refusal)}",
        {"places": [place_name(history, p) for p in (refusal.a, refusal.b)]},
    )


def _keyframe(anchor: commands.Anchor) -> Keyframe:
    return Keyframe(anchor.run_id, anchor.keyframe_id)


def _place_of(history: History, anchor: commands.Anchor, end: Offset) -> PlaceOrdinal | None:
    ordinal = history.keyframe_ordinals.get((anchor.run_id, anchor.keyframe_id))
    return None if ordinal is None else history.place_at(ordinal, end)


def _divided(
    history: History, anchors: Sequence[commands.Anchor], place: PlaceOrdinal, end: Offset
) -> tuple[list[commands.Anchor], list[commands.Anchor]]:
    """The anchors in a place, and the others."""
    own = [anchor for anchor in anchors if _place_of(history, anchor, end) == place]
    return own, [anchor for anchor in anchors if anchor not in own]


def _are_apart(
    history: History, own: Sequence[commands.Anchor], others: Sequence[commands.Anchor]
) -> bool:
    """Whether an own and another anchor are kept apart."""
    first, second = (map(_keyframe, anchors) for anchors in (own, others))
    return bool(history.corrections.apart.between(first, second))


def _named(history: History, anchors: Sequence[commands.Anchor], end: Offset) -> str:
    """The places of anchors, or the keyframes that are in none."""
    named = (
        f"{anchor.run_id}:{anchor.keyframe_id}"
        if (place := _place_of(history, anchor, end)) is None
        else place_name(history, place)
        for anchor in anchors
    )
    return ", ".join(dict.fromkeys(named))


def _moved(command: commands.CorrectPoses, keyframes: Collection[KeyframeId]) -> int:
    """The number of keyframes, of some of the command's run, whose pose the command corrects."""
    correction = PoseCorrection.of(command)
    if command.transform is None:
        return sum(keyframe_id in correction.poses for keyframe_id in keyframes)
    first, last = correction.span
    return sum(first <= keyframe_id <= last for keyframe_id in keyframes)
