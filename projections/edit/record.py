"""Make a command from the current map, find its effect, and record it: in the log, or by the
recorder that holds it.

The log is folded with the command before it is recorded. One that no fold can obey, or that would
not have its effect, is refused. An undo may be recorded even if the map cannot be folded with it:
it may be the first of several undos that are needed. If another command has been appended
meanwhile, the command is made again from the map after that.
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from itertools import combinations
from math import sqrt
from pathlib import Path
from typing import Any, Final, NamedTuple

from eventsrc.base.errors import LogBusy, LogError, MapfoldError, TransportError
from eventsrc.base.text import advised, visible
from eventsrc.envelope import commands as kinds
from eventsrc.envelope.commands import Anchor, Command, encode_command
from eventsrc.envelope.model import DetId, Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from eventsrc.log.lock import is_held
from eventsrc.record.recorder.edits import NewerCommand, NoAnswer, send_command
from eventsrc.record.transport.session import Session
from projections.fold.corrections import Keyframe, RecordedCommand, check_settings
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.map_errors import FoldError
from projections.map.parsing import read_commands
from projections.map.view import MapView

from .conflicts import EditRefused, describe
from .current import MapToEdit, SettingsOf
from .effect import Change, Effect
from .make import Stamp


class Outcome(NamedTuple):
    """``effect`` is None if it cannot be computed, ``unknown`` is then the reason; ``void`` are the
    commands that have no effect any more, with reasons; ``rooms`` tells which places
    became another type of room by names of classes."""

    change: Change
    effect: Effect | None
    unknown: str = ""
    void: tuple[tuple[RecordedCommand, str], ...] = ()
    rooms: tuple[str, ...] = ()


def outcome_of(current: MapToEdit, command: Command, *, recorded: bool) -> Outcome:
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
    rooms = tuple(_other_rooms(change)) if isinstance(command, kinds.Relabel) else ()
    return Outcome(change, effect, void=tuple(_void(change)), rooms=rooms)


def _other_rooms(change: Change) -> Iterator[str]:
    """A line for each place that is another type of room after the change than before."""
    before, after = (
        {
            place.place_id: (view.type_of(number), place.name)
            for number, place in view.places.items()
        }
        for view in (change.current.view, change.after)
    )
    for place_id, (found, name) in after.items():
        was, _ = before.get(place_id, (None, None))
        types = [None if each is None else each.type for each in (was, found)]
        if types[0] != types[1]:
            called = place_id if name is None else f"{place_id} ({name})"
            then, now = (each or "of no certain type" for each in types)
            yield visible(f"{called} was {then}, is {now} now, by the names of what is in it")


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
        case kinds.KeepApart() | kinds.UndoMerge():
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
        case kinds.DifferentObjects():
            located = Located.of(change.after)
            one, other = map(located.object, command.det_ids)
            if one is not None and one == other:
                raise EditRefused(
                    f"different-objects would not part {command.det_ids[0]!r} and "
                    f"{command.det_ids[1]!r}: both would be of one object still; name the "
                    "det_ids that founded two objects"
                )
        case kinds.Join() | kinds.SameObject() | kinds.CorrectPoses() | kinds.JoinFrames() if (
            effect.none
        ):
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
            case kinds.NamePlace():
                return self._not_placed((command.place,), 1)
            case kinds.KeepApart() | kinds.Join() | kinds.UndoMerge():
                why = self._not_placed(command.places, 2)
                if why or isinstance(command, kinds.Join):
                    return why
                places = {self.place(a) for a in command.places} - {None}
                return "" if len(places) > 1 else "what it keeps apart is one place"
            case kinds.SameObject() | kinds.DifferentObjects():
                for det_id in command.det_ids:
                    if det_id not in self.observations:
                        return f"its detection {det_id!r} is left out"
                    if self.object(det_id) is None:
                        return f"its detection {det_id!r} is of no object"
                if isinstance(command, kinds.SameObject):
                    return ""
                one, other = map(self.object, command.det_ids)
                return "what it keeps apart is one object" if one == other else ""
            case kinds.CorrectPoses():
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


MakeCommand = Callable[[MapToEdit, Stamp], Command]
"""A function that makes the command from the current map. Raises MisuseError."""
OpenSession = Callable[[], AbstractContextManager[Session]]
TIMEOUT_S: Final = 10.0
_TRIES: Final = 10


class _LogFree(Exception):
    """The writer that held the log has ended."""


class Made(NamedTuple):
    """A command, the map that it was made from, and its outcome; ``offset`` is None if it is not
    recorded, ``repeated`` if it was recorded by an earlier call."""

    command: Command
    current: MapToEdit
    outcome: Outcome
    offset: Offset | None
    repeated: bool = False


def make_command(
    reader: LogReader,
    make: MakeCommand,
    stamp: Stamp,
    settings_of: SettingsOf,
    note: Callable[[str], None],
) -> Made:
    """Make a command, fold the log with it, and record nothing. One that is in the log already is
    made as it was made then. Raises MisuseError, also if the log has another command of this id or
    cannot be folded with this one."""
    current = MapToEdit(reader, settings_of, note=note)
    known = current.find_command(stamp.command_id)
    if known is not None:
        current = MapToEdit(reader, settings_of, until=known.offset, note=note)
    command = make(current, stamp)
    check_settings(command)
    if known is not None and known.command != command:
        raise EditRefused(
            f"--command-id {visible(stamp.command_id)} is that of another command, at offset "
            f"{known.offset} (see `{advised('edits')}`); give another or none"
        )
    outcome = outcome_of(current, command, recorded=known is not None)
    offset = known.offset if known else None
    return Made(command, current, outcome, offset, repeated=known is not None)


def record_command(
    log: Path,
    make: MakeCommand,
    stamp: Stamp,
    settings_of: SettingsOf,
    open_session: OpenSession,
    note: Callable[[str], None] = lambda _: None,
) -> Made:
    """Make a command and append it; returns when it is durable.

    Raises MisuseError, LogError, TransportError, or LogBusy when the log is held by a writer that
    takes no commands.
    """
    for _ in range(_TRIES):
        with LogReader(log) as reader:
            made = make_command(reader, make, stamp, settings_of, note)
            if made.repeated:
                return made
            try:
                return made._replace(offset=_append(log, made, open_session))
            except NewerCommand as newer:
                last: MapfoldError = newer
            except _LogFree:
                last = LogBusy(f"{log} is written by one writer after another; try again")
    raise last


def recorded_document(made: Made) -> dict[str, Any]:
    """JSON of a recorded command: its offset and its effect."""
    effect = made.outcome.effect
    document = {
        "offset": made.offset,
        "command_id": made.command.command_id,
        "repeated": made.repeated,
        "effect": None if effect is None else effect.document(),
    }
    if effect is None:
        document["effect_unknown"] = made.outcome.unknown
    return document


def _append(log: Path, made: Made, open_session: OpenSession) -> Offset:
    try:
        writer = LogWriter(log)
    except LogBusy as busy:
        return _send(log, made, open_session, str(busy))
    with writer:
        with LogReader(log) as reader:
            commands = read_commands(reader)
        if commands and commands[-1].offset >= made.current.known_at:
            raise NewerCommand(commands[-1].offset)
        offset = Offset(writer.append(COMMAND_KEY, encode_command(made.command)))
        writer.sync()
    return offset


def _send(log: Path, made: Made, open_session: OpenSession, busy: str) -> Offset:
    command, current = made.command, made.current
    try:
        with open_session() as session:
            known_at = current.known_at
            log_id = current.reader.log_id
            return send_command(session, log_id, command, known_at, timeout_s=TIMEOUT_S).offset
    except NoAnswer:
        found = _find(log, command)  # the recorder may have ended between its sync and its reply
        if found is not None:
            return found
        _check_held(log)
        raise LogBusy(
            f"{busy.partition(';')[0]}, and no recorder answers for it; start the recorder with "
            "--accept-edits, or stop it and edit again; if it runs with --accept-edits, --connect "
            f"must name its router. `--command-id {visible(command.command_id)}` makes sure that "
            "the command is recorded once"
        ) from None
    except TransportError as error:
        _check_held(log)
        raise LogBusy(
            f"{busy.partition(';')[0]}; a recorder takes commands over Zenoh, but {error}"
        ) from None


def _check_held(log: Path) -> None:
    """Raise _LogFree if the writer that held the log, such as another `edit`, has ended."""
    if not is_held(log):
        raise _LogFree


def _find(log: Path, command: Command) -> Offset | None:
    with LogReader(log) as reader:
        commands = read_commands(reader)
    for recorded in commands:
        if recorded.command == command:
            return recorded.offset
    return None
