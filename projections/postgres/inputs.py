"""The inputs of a map: settings and corrections, both as of a point in the log."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final, Self, TypeAlias

import msgspec

from eventsrc.envelope.commands import NamePlace, Reembed
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader
from projections.fold.corrections import (
    Corrections,
    RecordedCommand,
    compile_corrections,
    map_fingerprint,
)
from projections.fold.pair_groups import ApartPairs
from projections.fold.settings import Settings
from projections.map.parsing import read_command, read_commands

from .sink import Checkpoint

SettingsOf: TypeAlias = Callable[[Corrections], Settings]
"""The settings that a map is made with under a log's corrections, which may name some."""
_PAGE_FUSION: Final = {
    name: Settings.model_fields[name].default
    for name in (
        *("fusion", "camera", "evidence", "localizer"),
        *("text_encoder", "text_encoder_sha256"),
    )
}
"""The settings that change Objects alone, or nothing in the map, with their defaults."""


_MOST_MADE: Final = 16
"""Inputs that are kept: each has all commands before it."""


@dataclass(frozen=True, slots=True)
class MapInputs:
    """``corrections`` are of the commands before the offset ``known_at``.

    ``fingerprint`` identifies settings and corrections. ``observed`` leaves out the corrections of
    places and Objects, and the settings of fusion by evidence and re-localisation: maps with the
    same one have the same observations, so vectors of one and a graph of the other go together.
    """

    settings: Settings
    corrections: Corrections
    known_at: Offset
    fingerprint: str
    observed: str

    @classmethod
    def of(cls, settings: Settings, corrections: Corrections, known_at: Offset) -> Self:
        """The inputs with both fingerprints computed."""
        of_observations = msgspec.structs.replace(
            corrections, apart=ApartPairs(), joined=(), different=ApartPairs(), same=(), names=()
        )
        return cls(
            settings,
            corrections,
            known_at,
            map_fingerprint(settings, corrections),
            map_fingerprint(settings.model_copy(update=_PAGE_FUSION), of_observations),
        )

    def checkpoint(
        self,
        log_id: str,
        next_offset: Offset = FIRST_OFFSET,
        last_event: str = "",
        digest: str | None = None,
        maps: str | None = None,
    ) -> Checkpoint:
        """The checkpoint of a map of these inputs with ``next_offset`` events."""
        return Checkpoint(
            log_id,
            self.fingerprint,
            self.settings.model_dump_json(),
            next_offset,
            last_event,
            digest,
            self.known_at,
            self.observed,
            maps,
        )

    @property
    def logged(self) -> Settings:
        """The settings of a command without options: the log's, else the defaults."""
        return self.corrections.settings or Settings()

    def known_to(self, known_at: Offset) -> "MapInputs":
        """The same inputs with another ``known_at``; no command may be between the two."""
        if known_at == self.known_at:
            return self
        return replace(self, known_at=known_at)

    def differs_only_in_names(self, other: "MapInputs") -> bool:
        """Whether the map of ``other`` is equal to this one, names of places aside."""
        return (
            self.settings == other.settings
            and self.corrections.differs_in_names_only(other.corrections)
            and self.vectors == other.vectors
        )

    @property
    def vectors(self) -> tuple[Reembed, ...]:
        """The ``reembed`` commands whose vectors the map has."""
        return self.corrections.reembedded_for(self.settings)


@dataclass(slots=True)
class LogInputs:
    """The commands of a log up to ``end``, and the choice of settings under them."""

    commands: list[RecordedCommand]
    settings_of: SettingsOf
    end: Offset
    _made: dict[int, MapInputs] = field(default_factory=dict)
    _index_of: dict[str, int] = field(default_factory=dict)
    """The first command with an id."""
    _first: list[bool] = field(default_factory=list)
    """Whether a command is that."""

    @classmethod
    def read(
        cls, reader: LogReader, settings: Settings | SettingsOf, end: Offset | None = None
    ) -> Self:
        """Read the commands before ``end``, of the whole log for None. Raises FoldError for one
        that cannot be read."""
        end = reader.next_offset if end is None else end
        settings_of = _fixed(settings) if isinstance(settings, Settings) else settings
        return cls(read_commands(reader, end), settings_of, end)

    def at(self, known_at: Offset) -> MapInputs:
        """The inputs under the commands before ``known_at``."""
        count = self._count_before(known_at)
        if count not in self._made:
            corrections = self._corrections(count)
            settings = self.settings_of(corrections)
            for oldest in list(self._made)[: 1 - _MOST_MADE]:
                del self._made[oldest]
            self._made[count] = MapInputs.of(settings, corrections, known_at)
        return self._made[count].known_to(known_at)

    def _corrections(self, count: int) -> Corrections:
        """The corrections of the first ``count`` commands. If those after the last ones that were
        compiled only give names, these are added, which takes no time for each older command."""
        for index in range(len(self._first), len(self.commands)):
            self._first.append(self._index_of.setdefault(self._id(index), index) == index)
        before = max((made for made in self._made if made < count), default=0)
        added = self.commands[before:count]
        are_names = all(isinstance(each.command, NamePlace) for each in added)
        if before and are_names and all(self._first[before:count]):
            return self._made[before].corrections.with_more_names(added)
        return compile_corrections(self.commands[:count])

    def _id(self, index: int) -> str:
        return self.commands[index].command.command_id

    def _count_before(self, offset: Offset) -> int:
        return bisect_left(self.commands, offset, key=lambda command: command.offset)

    @property
    def latest(self) -> MapInputs:
        """The inputs under all commands."""
        return self.at(self.end)

    def has_between(self, start: Offset, end: Offset) -> bool:
        """Whether there is a command from ``start`` to before ``end``."""
        at = self._count_before(start)
        return at < len(self.commands) and self.commands[at].offset < end

    def since(self, known_at: Offset) -> Sequence[RecordedCommand]:
        """The commands at ``known_at`` and later."""
        return [command for command in self.commands if command.offset >= known_at]

    def extend(self, commands: Sequence[RecordedCommand], end: Offset) -> None:
        """Add later commands, up to ``end``."""
        self.commands += commands
        self.end = max(self.end, end)


def _fixed(settings: Settings) -> SettingsOf:
    return lambda _: settings


def commands_between(reader: LogReader, start: Offset, end: Offset) -> list[RecordedCommand]:
    """The commands from ``start`` to before ``end``. Raises FoldError, LogDamaged."""
    return [read_command(event) for event in reader.read(start, end, keys=(COMMAND_KEY,))]
