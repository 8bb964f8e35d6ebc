"""What a log has before an import, and what an import has added.

What of a source is in the log already, and which of the source's commands it takes over:

An envelope is in it already if it has the same bytes and its keyframe is recorded; another event of
mapfold's own, or a verbatim message, if it has the same bytes, key and log time. Rejections are
appended again. An envelope of a known keyframe with other bytes is appended, too: the fold counts
it as a duplicate or reports it as a conflict.

Commands name things of their own log, so most are refused. Settings begin a new log. Names of
labels hold for any log that does not name these labels otherwise, and are taken over, with their
undos.
"""

import hashlib
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from eventsrc.base.errors import LogDamaged, MapfoldError
from eventsrc.base.text import command_line
from eventsrc.envelope import commands
from eventsrc.envelope.dropped_classes import NO_DROPPED, DropClasses, Dropped
from eventsrc.envelope.gaps import GapLedger
from eventsrc.envelope.ingest import CheckedEnvelope
from eventsrc.envelope.model import FIRST_OFFSET, Offset, RunId
from eventsrc.log import LogReader

from .ros_bags import BagReport
from .sources import PassedOver

IS_KNOWN: Final = "in the log already"
SETTINGS_CHOSEN: Final = "other settings than were chosen for the new log"


class NotTakenOver(ValueError):
    """A command that a log does not take over; the text says why and what to do."""


class LogCommands(NamedTuple):
    """The commands of a log. ``begins`` is the one that a new log begins with, None for one that
    says nothing yet; ``settings`` the document in force, None without any; ``labels`` names of
    classes in force by label; ``all`` all commands. ``differs`` tells, of the settings in force and
    those of a source, why they are not the same; empty if they are. It raises MapfoldError for
    settings that no fold can use. ``drops`` is the event that more classes are dropped, None for
    none; ``dropped`` are all classes that are, these among them."""

    begins: commands.UseSettings | None = None
    settings: Mapping[str, object] | None = None
    labels: Mapping[str, str] = {}
    all: Sequence[commands.Command] = ()
    differs: Callable[[Mapping[str, object] | None, Mapping[str, object]], str] = (
        lambda here, there: "" if here == there else "the settings are others"
    )
    drops: DropClasses | None = None
    dropped: Collection[str] = ()


class SourceCommands:
    """Decides which commands of a source are appended to a log."""

    def __init__(self, log: Path, known: LogCommands) -> None:
        self._log = log
        self._known = known
        self._settings = known.settings
        self._ids = {each.command_id for each in known.all}
        self.began = False
        """Whether a new log began with the settings of a source."""
        self.names_labels = bool(known.labels)
        """Whether a command, of the log or taken over, names labels."""

    def take(self, payload: bytes, *, is_first: bool) -> str:
        """Decide on the command in ``payload``: the reason to pass over it, empty to append it.
        ``is_first`` in a log without events. Raises NotTakenOver."""
        try:
            command = commands.parse_command(payload)
        except commands.InvalidCommand as error:
            raise NotTakenOver(f"no command: {error}") from None
        if isinstance(command, commands.UseSettings):
            return self._take_settings(command, is_first=is_first)
        if command.command_id in self._ids:
            return IS_KNOWN
        if isinstance(command, commands.Relabel):
            self._check_labels(command)
            self.names_labels = True
        elif not (isinstance(command, commands.Undo) and command.undone in self._ids):
            edit = command_line("edit", self._log, command.kind)
            raise NotTakenOver(
                f"{command.kind} is about things of its own log; `{edit}` gives it here"
            )
        self._ids.add(command.command_id)
        return ""

    def _take_settings(self, command: commands.UseSettings, *, is_first: bool) -> str:
        try:
            differs = self._known.differs(self._settings, command.settings)
        except MapfoldError as error:
            raise NotTakenOver(f"settings that no map can have: {error}") from None
        if is_first and self._known.begins is None:
            self._settings = command.settings
            self._ids.add(command.command_id)
            self.began = True
            return ""
        if not differs:
            return IS_KNOWN
        if self._known.begins is not None:
            return SETTINGS_CHOSEN
        raise NotTakenOver(differs)

    def _check_labels(self, command: commands.Relabel) -> None:
        for label, name in command.labels:
            here = self._known.labels.get(label, name)
            if here != name:
                edit = command_line("edit", self._log, "relabel", f"{label}={name}")
                raise NotTakenOver(
                    f"it calls label {label!r} {name!r}, which is {here!r} in this log; "
                    f"`{edit}` changes that"
                )


@dataclass(frozen=True, slots=True)
class ImportReport:
    """Counts of an import, which appended the events ``first_offset`` to ``next_offset`` - 1."""

    accepted: int
    rejected: int
    system: int
    """Rejected payloads, losses and maps of another mapfold log, copied unchanged."""
    skipped: int
    """Number of messages that were passed over."""
    first_offset: Offset
    next_offset: Offset
    maps: int = 0
    """Occupancy maps, given or among the messages."""
    verbatim: int = 0
    """Verbatim messages of another mapfold log, copied unchanged."""
    passed_over: tuple[PassedOver, ...] = ()
    """Messages that were passed over, by topic and what they are, in the order of the first."""

    @property
    def known(self) -> int:
        """How many messages were passed over because the log has them already."""
        return sum(each.count for each in self.passed_over if each.what == IS_KNOWN)

    @property
    def imported_nothing(self) -> bool:
        """Whether there were messages, all of them rejected or passed over, and none of them in the
        log already."""
        imported = self.accepted + self.system + self.maps + self.verbatim + self.known
        return not imported and bool(self.rejected or self.skipped)

    bags: tuple[BagReport, ...] = ()
    """The reports of the ROS 2 bags."""
    repeated: int | None = None
    """How many accepted envelopes are of keyframes that the log had already, with other bytes, and
    the fold ignores; None if no ledger was given."""
    began_as_source: bool = False
    """Whether a new log began with the settings that its first source begins with."""
    numbered_classes: bool = False
    """Whether all classes of accepted envelopes are numbers, and no command names any."""
    dropped: Dropped = NO_DROPPED
    """What was left out since the log never stores its class."""


@dataclass(slots=True)
class KnownEvents:
    """The events of a log before ``end``. ``ledger`` has its keyframes; without one, as of a
    damaged log, nothing counts as known."""

    log: Path
    end: Offset
    ledger: GapLedger[RunId] | None
    _by_key: dict[str | None, frozenset[bytes]] = field(default_factory=dict)

    def has_envelope(self, checked: CheckedEnvelope, payload: bytes) -> bool:
        """Whether the log has a keyframe with these bytes."""
        ledger = self.ledger
        if ledger is None or not ledger.has(checked.run_id, checked.keyframe_id):
            return False
        return _digest(payload, None) in self._of(None)

    def has(self, key: str, payload: bytes, logged_ns: int | None) -> bool:
        """Whether the log has this event under ``key``."""
        if logged_ns is None or self.ledger is None:
            return False
        return _digest(payload, logged_ns) in self._of(key)

    def _of(self, key: str | None) -> frozenset[bytes]:
        """The digests of the events of a key, of all envelopes for None; read once."""
        found = self._by_key.get(key)
        if found is None:
            found = self._by_key[key] = self._read(key)
        return found

    def _read(self, key: str | None) -> frozenset[bytes]:
        if self.end == FIRST_OFFSET:
            return frozenset()
        try:
            with LogReader(self.log) as reader:
                events = reader.read(FIRST_OFFSET, self.end, keys=None if key is None else {key})
                return frozenset(
                    _digest(event.payload, None if key is None else event.logged_ns)
                    for event in events
                    if key is not None or event.is_envelope
                )
        except LogDamaged as error:
            raise MapfoldError(
                f"{error}; it cannot be told what of the source is in the log already: run "
                f"`{command_line('log', 'recover', self.log)}` first"
            ) from None


def _digest(payload: bytes, logged_ns: int | None) -> bytes:
    """A digest of an event; 16 bytes, so that those of a million events take 80 MB."""
    digest = hashlib.blake2b(payload, digest_size=16)
    if logged_ns is not None:
        digest.update(b" %d" % logged_ns)
    return digest.digest()
