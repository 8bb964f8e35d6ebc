"""The maps that agents ask, each with what names it, so that an answer can be cited and checked.

`LogMaps` has a log at every moment and follows it as it grows; `LiveMaps` has the databases' map.
Neither is for several threads at once.
"""

import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

from eventsrc.base.errors import LogDamaged, LogError, MisuseError
from eventsrc.base.text import advised
from eventsrc.envelope.commands import Command
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from eventsrc.log.seek import resolve
from projections.ask.words import ObjectVectors, Words
from projections.edit.current import MapToEdit
from projections.edit.make import Stamp
from projections.edit.record import MakeCommand, OpenSession, record_command, recorded_document
from projections.history import LogTimeline
from projections.history.timeline import SettingsChoice
from projections.localize.relocalize import ExactIndex, MapCandidates, QuestionCrop
from projections.map.digest import map_digest
from projections.map.view import MapView
from projections.store.history_recorder import map_after
from projections.surfaces.serve import Pools
from projections.surfaces.text_encoders import words_of


@dataclass(frozen=True, slots=True)
class MapName:
    """The map after the first ``offset`` events of a log under the commands before ``known_at``,
    and its digest. The map of the databases has no digest: it lacks what the digest is made of."""

    log_id: str | None
    offset: Offset
    known_at: Offset | None
    digest: str | None

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


class CitedMap(NamedTuple):
    """A map and its name."""

    view: MapView
    name: MapName

    def moment(self, at: str, known_at: str | None) -> tuple[str, str | None]:
        """``at`` and ``known_at`` of this map, also when the log has grown since."""
        if self.name.known_at is None:
            return at, known_at
        return str(self.name.offset), str(self.name.known_at)


class LogMaps:
    """The maps of a log; a context manager. ``issued_by`` gives the commands of `record`."""

    def __init__(
        self,
        log: Path,
        settings: SettingsChoice,
        *,
        cache: bool = True,
        note: Callable[[str], None] = lambda _: None,
        issued_by: str = "mcp",
        open_session: OpenSession | None = None,
    ) -> None:
        self._log, self._settings, self._cache, self._note = log, settings, cache, note
        self._issued_by, self._open_session = issued_by, open_session
        self._timeline = LogTimeline(log, settings, note=note, cache=cache)
        self._kept: tuple[tuple[Offset, Offset], CitedMap] | None = None
        self._index: tuple[tuple[Offset, Offset], ExactIndex] | None = None

    def __enter__(self) -> "LogMaps":
        return self

    def __exit__(self, *_: object) -> None:
        self._timeline.reader.close()

    def map(self, at: str, known_at: str | None) -> CitedMap:
        """The map at a moment, not to be changed; the log's end is that of now. Raises MisuseError,
        as all questions do."""
        return self._at(*self._moment(at, known_at))

    def words(self, cited: CitedMap) -> Words | None:
        """What compares words with the embeddings of a map; None where nothing does."""
        return words_of(cited.view)

    def candidates(
        self, crops: Sequence[QuestionCrop], at: str, known_at: str | None
    ) -> MapCandidates:
        """What is similar to some crops. The last map asked is kept with its vectors."""
        moment = self._moment(at, known_at)
        if self._index is None or self._index[0] != moment:
            end, known = moment
            corrections = self._timeline.corrections(known)
            view = map_after(
                self._timeline.reader,
                self._settings(corrections),
                end,
                corrections=corrections,
                note=self._note,
                cache=self._cache,
                embeddings=True,
            )
            self._index = moment, ExactIndex(view)
        return self._index[1].search(crops)

    def changes(self, since: str | None, until: str) -> tuple[CitedMap, dict[str, Any]]:
        """The later map, and what changed in the building until it, as ``changes --json``."""
        self._refresh()
        end = self._timeline.moment(until, is_end=True)
        start = None if since is None else self._timeline.moment(since, is_end=False)
        return self._at(end, end), self._timeline.changes(start, end).document()

    def why(self, thing: str, other: str | None, at: str, known_at: str | None) -> dict[str, Any]:
        """Why a thing is what it is, or two keyframes are in one place, as ``why --json``."""
        end, known_end = self._moment(at, known_at)
        known = self._timeline.knowing(known_end)
        found = known.why(thing, end) if other is None else known.why_same(thing, other, end)
        return found.document()

    def record(self, make: MakeCommand, reason: str) -> dict[str, Any]:
        """Record a command, as ``edit --json``. Raises MisuseError, LogError, TransportError."""
        if self._open_session is None:
            raise MisuseError("the log is not to be changed; start with --allow-edits")

        def checked(current: MapToEdit, stamp: Stamp) -> Command:
            self._refuse_other(current.reader)
            return make(current, stamp)

        stamp = Stamp(uuid.uuid4().hex, self._issued_by, reason)
        made = record_command(
            self._log, checked, stamp, self._settings, self._open_session, self._note
        )
        return recorded_document(made)

    def _refresh(self) -> None:
        """Include events recorded since. Raises LogError where another log, or none, or less of it
        is there."""
        known = self._timeline.reader.readable_end
        with LogReader(self._log) as there:
            self._refuse_other(there)
            if there.readable_end < known:
                raise LogDamaged(
                    f"{self._log} has {there.readable_end:,} events that can be read now and had"
                    f" {known:,}; run `{advised('log', 'recover', self._log)}`"
                )
        self._timeline.refresh()

    def _refuse_other(self, there: LogReader) -> None:
        if there.log_id != self._timeline.reader.log_id:
            raise LogError(f"there is another log at {self._log} now; start this command again")

    def _moment(self, at: str, known_at: str | None) -> tuple[Offset, Offset]:
        self._refresh()
        end = resolve(self._timeline.reader, at)
        return end, end if known_at is None else resolve(self._timeline.reader, known_at)

    def _at(self, end: Offset, known: Offset) -> CitedMap:
        if self._kept is None or self._kept[0] != (end, known):
            view = self._timeline.at(end, known_at=known)
            name = MapName(self._timeline.reader.log_id, end, known, map_digest(view))
            self._kept = (end, known), CitedMap(view, name)
        return self._kept[1]


class LiveMaps:
    """The one map of the databases, as it is when it is asked."""

    def __init__(self, pools: Pools) -> None:
        self._pools = pools

    def map(self, at: str, known_at: str | None) -> CitedMap:
        """The map; refuses a past one."""
        self._refuse_past(at, known_at)
        view = self._pools.view()
        return CitedMap(view, MapName(view.log_id, view.next_offset, None, None))

    def words(self, cited: CitedMap) -> Words | None:
        """What compares words with the embeddings of the map; None where nothing does."""
        return words_of(cited.view, self._vectors)

    def _vectors(self, _: MapView) -> ObjectVectors:
        return self._pools.object_vectors()

    def candidates(
        self, crops: Sequence[QuestionCrop], at: str, known_at: str | None
    ) -> MapCandidates:
        """What is similar to some crops."""
        self._refuse_past(at, known_at)
        return self._pools.candidates(crops)

    def changes(self, since: str | None, until: str) -> tuple[CitedMap, dict[str, Any]]:
        """Refused: the databases have one map."""
        raise MisuseError(f"what changed since {since or 'the last run'} until {until} {_ONLY_LOG}")

    def why(self, thing: str, other: str | None, at: str, known_at: str | None) -> dict[str, Any]:
        """Refused: the databases do not have the events."""
        asked = thing if other is None else f"{thing} and {other}"
        raise MisuseError(f"why {asked}, at {at}, known at {known_at or at}, {_ONLY_LOG}")

    def _refuse_past(self, at: str, known_at: str | None) -> None:
        if at != "end" or known_at is not None:
            raise MisuseError(f"the map at {at}, known at {known_at or at}, {_ONLY_LOG}")


_ONLY_LOG = "is known only by the log; give LOG instead of --db"


def offsets_in(document: object) -> set[int]:
    """The offsets of events that a document names."""
    if isinstance(document, Mapping):
        found = set[int]()
        for key, value in document.items():
            if key == "offset" and isinstance(value, int):
                found.add(value)
            elif key == "offsets":
                found.update(value)
            else:
                found |= offsets_in(value)
        return found
    if isinstance(document, list | tuple):
        return set[int]().union(*map(offsets_in, document))
    return set()
