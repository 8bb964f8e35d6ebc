"""The effect of a command on the map of the events before it, counts and the whole difference, and
the list of a log's commands with their effects, as text and as JSON.
"""

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from eventsrc.base.progress import working
from eventsrc.base.text import advised, counted, table, visible
from eventsrc.envelope import commands as kinds
from eventsrc.envelope.commands import Command, encode_command
from eventsrc.envelope.model import Offset
from eventsrc.log import cache_folder, make_cache_folder, write_cache_file
from projections.fold.corrections import (
    Corrections,
    RecordedCommand,
    compile_corrections,
    map_fingerprint,
)
from projections.fold.deltas import PlaceNamed, PlaceOrdinal
from projections.fold.settings import Settings, assignment_texts, settings_by_name
from projections.history.diff import Difference, difference_of, rows_of
from projections.map.phrases import command_document, iso_time
from projections.map.view import MapView

from .current import MapToEdit, SettingsOf
from .make import undone_by

_CACHE = "effects.json"
_COMPARING = "comparing the maps"
_VERSION = 2
"""The version of cached effects; to be raised when a fold gives another map of the same log."""
_MAX_CACHE_BYTES = 16 * 1024 * 1024


class Effect(NamedTuple):
    """The numbers of places, objects and keyframes that are new, gone or changed."""

    places: int
    objects: int
    keyframes: int

    @property
    def none(self) -> bool:
        """Whether nothing changed."""
        return not any(self)

    def document(self) -> dict[str, Any]:
        """JSON."""
        return self._asdict()

    def __str__(self) -> str:
        """``3 places, 1 object, 12 keyframes``."""
        named = zip(self, ("place", "object", "keyframe"), strict=True)
        return ", ".join(counted(number, what) for number, what in named)


class Change:
    """The change from a map to that of the same log with other commands.

    Folds only if needed: names of places alone need no fold.
    """

    def __init__(self, current: MapToEdit, commands: Sequence[RecordedCommand]) -> None:
        self.current = current
        self.corrections = compile_corrections(commands)
        self.settings = current.settings_of(self.corrections)
        self._after: MapView | None = None

    @classmethod
    def by(cls, current: MapToEdit, command: Command) -> "Change":
        """The change made by one further command."""
        return cls(current, [*current.commands, RecordedCommand(current.end, command)])

    @property
    def after(self) -> MapView:
        """The map under the other commands."""
        if self._after is None:
            current = self.current
            if self._same_fold(current.corrections, self.corrections):
                self._after = current.view
            elif self._names_only:
                self._after = self._renamed()
            else:
                self._after = current.fold(self.corrections, self.settings)
        return self._after

    def _renamed(self) -> MapView:
        view = self.current.another_view()
        before, after = (_names(self.current, c) for c in (view.corrections, self.corrections))
        for place in sorted(_differing(before, after)):
            name, command = after.get(place, (None, None))
            view.apply(PlaceNamed(self.current.end, place, name, command))
        view.corrections = self.corrections
        return view

    @property
    def known_after(self) -> MapView | None:
        """The map under the other commands, if it is folded already."""
        return self._after

    def _same_fold(self, first: Corrections, second: Corrections) -> bool:
        same_settings = self.settings == self.current.settings
        folds = [map_fingerprint(self.settings, each) for each in (first, second)]
        return same_settings and folds[0] == folds[1]

    @property
    def _names_only(self) -> bool:
        before, after = self.current.corrections, self.corrections
        return self._same_fold(before.without_names(), after.without_names())

    def effect(self) -> Effect:
        """The counts of changes."""
        if self._names_only:
            before, after = (
                {place: name for place, (name, _) in _names(self.current, corrections).items()}
                for corrections in (self.current.corrections, self.corrections)
            )
            return Effect(len(_differing(before, after)), 0, 0)
        return effect_of(self.current.view, self.after)

    def difference(self) -> Difference:
        """The whole difference."""
        before, after = self.current.view, self.after
        with working(_COMPARING):
            return difference_of(before, after, {}, ())


def effect_of(before: MapView, after: MapView) -> Effect:
    """The counts of differences between two maps of the same events."""
    with working(_COMPARING):
        first, second = rows_of(before), rows_of(after)
        return Effect(
            len(_differing(first.places, second.places)),
            len(_differing(first.objects, second.objects)),
            len(_differing(first.keyframes, second.keyframes)),
        )


def _names(current: MapToEdit, corrections: Corrections) -> dict[PlaceOrdinal, tuple[str, Offset]]:
    """Places by ordinal, their names and the commands that gave them; the later name counts."""
    placed = ((current.place_of(n.anchor), (n.name, n.offset)) for n in corrections.names)
    return {place: name for place, name in placed if place is not None}


def _differing(first: dict[Any, Any], second: dict[Any, Any]) -> set[Any]:
    """The keys whose values differ or are in one of the two only."""
    return {key for key in {**first, **second} if first.get(key) != second.get(key)}


class EffectCache:
    """A cache of effects: ``<log>.history/effects.json``, safe to delete. Its keys are those of
    `effect_keys`."""

    def __init__(self, current: MapToEdit) -> None:
        self._note = current.note
        log = current.reader.path
        self._log_id = current.reader.log_id
        self._log = log
        self._path = cache_folder(log) / _CACHE
        self._effects = self._read()

    def get(self, key: str) -> Effect | None:
        """The effect of a command, if it is known."""
        return self._effects.get(key)

    def put(self, key: str, effect: Effect) -> None:
        """Keep an effect. A cache that cannot be written is left as it is, with a note."""
        self._effects = {**self._read(), key: effect}
        document = {"version": _VERSION, "log_id": self._log_id, "effects": self._effects}
        data = json.dumps(document).encode()
        try:
            make_cache_folder(self._log)
            write_cache_file(self._path, lambda file: file.write(data))
        except OSError as error:
            self._note(f"{self._path}: no effect was kept: {error.strerror}")

    def _read(self) -> dict[str, Effect]:
        """The cached effects; none if the file is of another log or was not written by this
        code."""
        try:
            if self._path.stat().st_size > _MAX_CACHE_BYTES:
                return {}
            document = json.loads(self._path.read_text("utf-8"))
            if (document["version"], document["log_id"]) != (_VERSION, self._log_id):
                return {}
            return {str(key): Effect(*map(int, row)) for key, row in document["effects"].items()}
        except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
            return {}


def cache_effect(current: MapToEdit, command: Command, effect: Effect) -> None:
    """Keep the effect of a command that was recorded right behind the events of the map."""
    commands = [*current.commands, RecordedCommand(current.end, command)]
    *_, key = effect_keys(current.settings_of, commands)
    EffectCache(current).put(key, effect)


def effect_keys(settings_of: SettingsOf, commands: Iterable[RecordedCommand]) -> Iterator[str]:
    """The key of the effect of each command of a log: the same for the same commands up to it and
    the same settings under each that could be in force.

    Made from the key before it, not from what the commands compile to: that would take as long for
    each as for all.
    """

    def fingerprint_under(settings: Settings | None) -> str:
        return settings_of(Corrections(settings=settings)).fingerprint()

    known: dict[bytes, str] = {}
    digest = hashlib.sha256(fingerprint_under(None).encode())
    for offset, command in commands:
        encoded = encode_command(command)
        digest.update(f" {offset} {len(encoded)} ".encode() + encoded)
        if isinstance(command, kinds.UseSettings):
            named = json.dumps(command.settings).encode()
            if named not in known:
                known[named] = fingerprint_under(Settings.from_document(command.settings))
            digest.update(known[named].encode())
        yield digest.hexdigest()[:32]


def effects_of(current: MapToEdit, known_only: bool) -> list[tuple[RecordedCommand, Effect | None]]:
    """Every command of a log with its effect on the map of the events before it.

    With ``known_only`` nothing is folded, and effects not in the cache are None.
    """
    cache = EffectCache(current)
    keys = effect_keys(current.settings_of, current.commands)
    known = [cache.get(key) for key in keys]
    found = list(zip(current.commands, known, strict=True))
    if known_only or None not in known:
        return found
    change: Change | None = None
    keys = effect_keys(current.settings_of, current.commands)
    for number, ((recorded, effect), key) in enumerate(zip(found, keys, strict=True)):
        if effect is not None:
            change = None
            continue
        then = MapToEdit(
            current.reader,
            current.settings_of,
            until=recorded.offset,
            commands=current.commands[:number],
            corrections=None if change is None else change.corrections,
        )
        if (
            change is not None
            and change.known_after is not None
            and recorded.offset == change.current.end + 1
        ):  # a command changes nothing by itself
            then.set_view(change.known_after)
        change = Change.by(then, recorded.command)
        effect = change.effect()
        cache.put(key, effect)
        found[number] = recorded, effect
    return found


Found = Sequence[tuple[RecordedCommand, Effect | None]]


def what(command: Command) -> str:
    """A short description of a command's subject."""
    match command:
        case kinds.NamePlace():
            return f"{_name(command.place)} is {command.name}"
        case kinds.KeepApart() | kinds.Join():
            return " and ".join(map(_name, command.places))
        case kinds.UndoMerge():
            return f"at {command.merge_offset}: {' and '.join(map(_name, command.places))}"
        case kinds.SameObject() | kinds.DifferentObjects():
            return " and ".join(command.det_ids)
        case kinds.DropObject() | kinds.DropDetection():
            more = len(command.det_ids) - 1
            return command.det_ids[0] + (f" and {more:,} more" if more else "")
        case kinds.ForgetRun():
            return command.run_id
        case kinds.ForgetKeyframes():
            return f"{command.run_id}:{command.first}..{command.last}"
        case kinds.CorrectPoses():
            return f"{command.run_id}: {_poses(command)}"
        case kinds.JoinFrames():
            into = "the map's own" if command.into is None else command.into
            return f"{command.frame} into {into}: {_move(command.transform)}"
        case kinds.Relabel():
            (label, name), *others = command.labels
            return f"{label} is {name}" + (f" and {len(others):,} more" if others else "")
        case kinds.UseSettings():
            plain, given = _default_settings(), settings_by_name(command.settings)
            changed = {name: value for name, value in given.items() if plain.get(name) != value}
            return ", ".join(assignment_texts(changed)) or "the defaults"
        case kinds.Reembed():
            return f"{counted(command.detections, 'detection')} in {command.space}"
        case kinds.Undo():
            return command.undone


@cache
def _default_settings() -> Mapping[str, Any]:
    return Settings().by_name()


def _name(anchor: Any) -> str:
    return f"{anchor.run_id}:{anchor.keyframe_id}"


def _poses(command: kinds.CorrectPoses) -> str:
    if command.transform is None:
        return counted(len(command.poses), "pose")
    span = ""
    if command.first is not None or command.last is not None:
        first = "" if command.first is None else command.first
        span = f" of {first}..{'' if command.last is None else command.last}"
    return f"{_move(command.transform)}{span}"


def _move(by: kinds.RigidTransform) -> str:
    return f"dx={by.dx:g} dy={by.dy:g} dyaw={by.dyaw:g}"


def edits_text(found: Found, times: Mapping[Offset, int]) -> str:
    """A table of the commands, two lines for each, and what to do next."""
    if not found:
        return f"no command in this log; `{advised('edit')}` records one\n"
    undone = undone_by([recorded for recorded, _ in found])
    first_of = _first_offsets(found)
    rows = []
    for (offset, command), effect in found:
        by = undone.get(command.command_id)
        state = "" if by is None else f"undone by {visible(by.command.command_id)}"
        if (first := first_of[command.command_id]) != offset:
            state = f"not counted: its id is that of {first}"
        rows.append(
            [
                str(offset),
                iso_time(times[offset] / 1e9),
                visible(command.issued_by),
                f"{command.kind} {visible(what(command))}",
                "not computed" if effect is None else str(effect),
                visible(command.command_id),
                state,
                visible(command.reason),
            ]
        )
    header = ("offset", "time", "by", "command", "changed", "command id", "undone", "reason")
    text = table(header, rows, right={"offset"})
    if any(effect is None for _, effect in found):
        text += "--effects computes the missing ones\n"
    return text


def edits_document(found: Found, times: Mapping[Offset, int]) -> list[dict[str, Any]]:
    """JSON: an object for each command, in order of offset. One whose command_id an earlier one has
    does not count, and has that one's offset as ``repeats``."""
    first_of = _first_offsets(found)
    undone = undone_by([recorded for recorded, _ in found])
    return [
        {
            **command_document(recorded),
            "time": iso_time(times[recorded.offset] / 1e9),
            "what": what(recorded.command),
            "effect": None if effect is None else effect.document(),
            "undone_by": _id_of(undone.get(recorded.command.command_id)),
            **_repeats(first_of[recorded.command.command_id], recorded.offset),
        }
        for recorded, effect in found
    ]


def _id_of(recorded: RecordedCommand | None) -> str | None:
    return None if recorded is None else recorded.command.command_id


def _first_offsets(found: Found) -> dict[str, Offset]:
    """The offset of the command that counts, for each command_id."""
    first: dict[str, Offset] = {}
    for recorded, _ in found:
        first.setdefault(recorded.command.command_id, recorded.offset)
    return first


def _repeats(first: Offset, offset: Offset) -> dict[str, Offset]:
    return {} if first == offset else {"repeats": first}
