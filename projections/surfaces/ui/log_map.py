"""The log as the page reads it, and its map under one choice of settings.

Where the log cannot be read or folded, the map ends, with a sentence in ``problems``. The history
is folded once, later questions are look-ups; new events are folded when `refresh` finds them. Not
for several threads at once.
"""

import hashlib
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from eventsrc.base.errors import LogDamaged, LogError, LogNotFound, MapfoldError
from eventsrc.base.text import command_line, counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader, Unreadable
from eventsrc.log.format import list_growing
from eventsrc.log.reader import OnGap
from eventsrc.log.seek import resolve
from projections.ask.kept_crops import KeptCrops
from projections.fold.corrections import Corrections, map_fingerprint
from projections.fold.map_errors import FoldError
from projections.fold.settings import Settings
from projections.history import LogTimeline, Progress
from projections.history.timeline import SettingsChoice
from projections.localize.evaluate.truth import Truth

from .log_events import MOST_REPORTS, LogEvents

_NO_LIMIT = Offset(sys.maxsize)
_ASK_EVERY = 500


class PrefixReader(LogReader):
    """A `LogReader` that takes a log to end at ``limit``, if it has as many events.

    Nothing beyond the limit is read, so damage there is no error. ``go_on`` is called regularly
    while events are read; an exception from it ends the reading.
    """

    def __init__(
        self, path: Path, limit: Offset = _NO_LIMIT, go_on: Callable[[], None] = lambda: None
    ) -> None:
        self.limit, self._go_on = limit, go_on
        super().__init__(path)

    @property
    def next_offset(self) -> Offset:
        """The number of events up to the limit."""
        return self.limit if self.is_limited else super().next_offset

    @property
    def readable_end(self) -> Offset:
        """The number of events up to the limit and before those that cannot be read."""
        return min(super().readable_end, self.limit)

    @property
    def is_limited(self) -> bool:
        """Whether the log has events beyond the limit."""
        end = super().readable_end
        return self.limit < end or (self.limit == end and self._unreadable_end is not None)

    def refresh(self) -> Offset:
        """Find what was committed since; the new `next_offset`."""
        if not self.is_limited:
            super().refresh()
        return self.next_offset

    def check_end(self) -> None:
        """As that of a `LogReader`, but segments beyond the limit may be missing."""
        if not self.is_limited:
            super().check_end()

    def read(
        self,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        keys: Collection[str] | None = None,
        on_gap: OnGap | None = None,
    ) -> Iterator[Event]:
        """Events from ``start`` to before ``end``, at most to the limit."""
        if self.is_limited:
            end = self.next_offset if end is None else min(end, self.next_offset)
        for number, event in enumerate(super().read(start, end, keys=keys, on_gap=on_gap)):
            if number % _ASK_EVERY == 0:
                self._go_on()
            yield event

    def first_unreadable(self) -> Offset | None:
        """The first offset whose event cannot be read; None if all can. Reads the whole log."""
        found: list[Unreadable] = []
        for _ in super().read(on_gap=found.append):
            if found:
                break
        return found[0].first if found else None


@dataclass(frozen=True, slots=True)
class Opened:
    """A log and the options of the debugger.

    ``settings`` gives those of the map under some corrections: of ``settings_file`` or the log,
    changed by ``sets`` (``name=value``). ``truth``, of ``truth_files``, scores what-ifs. ``edits``:
    the log may be changed. ``token_needed``: every question needs the token. ``cache``: histories
    are read and kept beside the log.
    """

    log: Path
    settings: SettingsChoice
    sets: tuple[str, ...] = ()
    settings_file: Path | None = None
    truth_files: tuple[Path, ...] = ()
    truth: Truth | None = None
    edits: bool = False
    token_needed: bool = False
    cache: bool = True

    def words(self, *sets: str) -> list[str]:
        """The options that give a command the same settings, changed by ``sets``."""
        words = [] if self.settings_file is None else ["--settings", str(self.settings_file)]
        last = {text.partition("=")[0].strip(): text for text in (*self.sets, *sets)}
        return words + [word for text in last.values() for word in ("--set", text)]

    def base_words(self) -> list[str]:
        """The options that give ``mapfold whatif`` the same base."""
        words = [] if self.settings_file is None else ["--settings", str(self.settings_file)]
        words += ["--base", " ".join(self.sets)] if self.sets else []
        return words + [word for file in self.truth_files for word in ("--truth", str(file))]


MOST_HISTORIES: Final = 4
"""Histories of the log's own settings that are kept: one for each set of commands asked about."""
MOST_ALTERNATIVES: Final = 2
"""Maps under other settings that are kept, each with one history."""


class LogMap:
    """A context manager over an existing log. Raises LogError when there is none.

    ``sets`` (``name=value``) change the settings that it was opened with. ``progress`` is called
    while events are folded.
    """

    def __init__(
        self,
        opened: Opened,
        sets: Sequence[str] = (),
        *,
        progress: Progress | None = None,
        histories: int = MOST_HISTORIES,
    ) -> None:
        self.opened = opened

        def settings(corrections: Corrections) -> Settings:
            return opened.settings(corrections).with_assignments(sets, "set")

        self.reader = PrefixReader(opened.log)
        self.timeline = LogTimeline(
            opened.log,
            settings,
            progress=progress,
            reader=self.reader,
            histories=histories,
            cache=opened.cache and not sets,  # a trial of settings is not kept
        )
        self.log_events = LogEvents()
        self.log_id = self.reader.log_id
        self.crops = KeptCrops(self.reader)
        self.packed: tuple[object, bytes] | None = None
        """The last whole history as an answer, and what it is of."""
        self._files, self._size = _files(opened.log)
        self._stopped: str | None = None
        self._lost: str | None = None

    def __enter__(self) -> "LogMap":
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    @property
    def through(self) -> Offset:
        """The number of events that every answer covers."""
        return self.timeline.end

    @property
    def lost(self) -> str | None:
        """Why the part of the log that was read cannot be read any more; None if it can."""
        return self._lost

    @property
    def problems(self) -> list[str]:
        """Warnings about the map, as sentences."""
        found = [problem for problem in (self._lost, self._stopped) if problem is not None]
        if left_out := self.log_events.left_out:
            found.append(
                f"the timeline marks the first {MOST_REPORTS:,} rejected payloads and losses,"
                f" not the {left_out:,} after them"
            )
        record, read = (f"`{command_line(name, self.opened.log)}" for name in ("record", "import"))
        how = f"{record}` records a robot, {read} FILE` reads a file"
        if self.through == 0 and not found:
            return [f"the log has no events yet; this page shows them as they are recorded: {how}"]
        history = self.timeline.history
        if self.through and not history.keyframes:
            found.append(
                f"none of the {counted(self.through, 'event')} is a keyframe, so there is no map;"
                f" {how}"
            )
        elif history.keyframes and all(k.pose is None for k in history.keyframes):
            found.append(
                f"none of the {counted(len(history.keyframes), 'keyframe')} has a pose, so there"
                " are no places and there is nothing to draw"
            )
        return found

    @property
    def key(self) -> str:
        """A key that stays equal while the map only grows, and changes when maps of the past
        change."""
        known = self.timeline.corrections()
        offsets = ",".join(str(command.offset) for command in known.in_force)
        map_ = map_fingerprint(self.timeline.settings, known)
        made = f"{self.log_id} {map_} {offsets} {self._stopped}"
        return hashlib.sha256(made.encode()).hexdigest()[:16]

    def refresh(self, end: Offset | None = None) -> bool:
        """Fold the events recorded since, at most to ``end``; whether anything is new.

        Errors of a log that is damaged, deleted or cannot be folded are in `problems`, not raised.
        """
        before = self.through, self._lost, self._stopped
        if end is not None:
            self.reader.limit = end
        self._lost = None
        try:
            if end is None:
                self._check_same()
                self.reader.check_end()
            self.timeline.refresh()
        except LogError as error:
            self._lost = str(error)
        self._fold()
        return before != (self.through, self._lost, self._stopped)

    def point(self, text: str, note: Callable[[str], None] | None = None) -> Offset:
        """The number of events of a W, written as for ``--at``."""
        return resolve(self.reader, text, note=note)

    def _check_same(self) -> None:
        """Raises LogError if there is no log any more where it was, another one, or a part."""
        path = self.reader.path
        files, size = _files(path)
        if files == self._files and size >= self._size:
            self._size = size
            return
        if not path.exists():
            raise LogNotFound(f"the log at {path} is gone; this page shows what was read before")
        with LogReader(path) as reader:
            if reader.log_id != self.log_id:
                raise LogError(
                    f"there is another log at {path} now; this page shows the one that was there."
                    " Start mapfold ui again"
                )
            if reader.next_offset < self.through:
                raise LogError(
                    f"the log at {path} has {counted(reader.next_offset, 'event')} now, fewer than"
                    f" the {self.through} that this page shows. Start mapfold ui again"
                )
        self._files, self._size = files, size

    def _fold(self) -> None:
        """Fold to the end, or to where that is not possible."""
        while True:
            try:
                _ = self.timeline.history
                self.log_events.read_on(self.reader, self.through)
            except LogDamaged as error:
                stop = self.reader.first_unreadable()
                self._stop_at(stop, error)
            except FoldError as error:
                self._stop_at(error.offset, error)
            else:
                return

    def _stop_at(self, offset: Offset | None, error: MapfoldError) -> None:
        """End the map before the event at ``offset``."""
        if offset is None or offset >= self.reader.next_offset:
            raise error
        self.reader.limit = offset
        self._stopped = f"{error}. The map shown ends before it, after {counted(offset, 'event')}"
        self.timeline.refresh()


def _files(path: Path) -> tuple[tuple[int, ...], int]:
    """Identifies the folder and its last segment, to detect replaced ones; and the bytes of that
    segment, to detect a truncated one."""
    try:
        status = [path.stat(), *(entry.path.stat() for entry in list_growing(path)[-1:])]
    except OSError:
        return (), 0
    return tuple(n for each in status for n in (each.st_dev, each.st_ino)), status[-1].st_size
