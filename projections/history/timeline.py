"""The maps of one log at every offset, and why they are as they are.

**The map at W is the fold of the events before W under the commands recorded before V**, V being
``known_at``: W itself unless asked otherwise, and for a question about a span its end. A timeline
folds its log once for each set of commands that it is asked under, so once in all if the log has no
commands.
"""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from eventsrc.log.seek import Note, resolve, time_of
from projections.ask.what_changed import MapChanges, last_run_start, map_changes, run_span
from projections.fold.corrections import Corrections, RecordedCommand, compile_corrections
from projections.fold.settings import Settings
from projections.map.fold import FoldedEvent
from projections.map.naming import NoSuchThing
from projections.map.parsing import read_commands
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_records import Cause, Merge

from .bisect import Search
from .condition_functions import HistoryFacts
from .conditions import Expression
from .diff import Difference, difference_of
from .explanation import Explanation
from .known_history import KnownHistory, Progress, checked_end
from .names import place_name

SettingsChoice: TypeAlias = Callable[[Corrections], Settings]
"""A function that returns the settings to fold with under some corrections, which may hold the
settings recorded in the log."""

_MOMENTS = "; or give a day such as 2026-03-24, a time, RUN:KEYFRAME, a number of events or end"
_DAY = re.compile(r"\d{4}-\d{2}-\d{2}", re.ASCII)
_MOST_HISTORIES = 4
"""Histories that are kept; each may take as much memory as the map."""
_MOST_COMPILED = 16
"""Corrections that are kept, of the moments of knowledge asked about last."""


class LogTimeline:
    """A context manager over a log. An ``end`` means the map after that many events.

    ``settings`` are those of every fold, or a function of the corrections; by default those
    recorded in the log. ``progress`` is called while events are folded, ``note`` with a line about
    each part of a kept history that could not be used. ``reader`` reads ``log`` instead of a new
    reader; the timeline closes it. At most ``histories`` are kept in memory. Without ``cache`` none
    is read or kept beside the log.
    """

    def __init__(
        self,
        log: Path,
        settings: Settings | SettingsChoice | None = None,
        *,
        progress: Progress | None = None,
        note: Callable[[str], None] = lambda _: None,
        reader: LogReader | None = None,
        histories: int = _MOST_HISTORIES,
        cache: bool = True,
    ) -> None:
        self._settings = settings
        self.reader = LogReader(log) if reader is None else reader
        self._most = histories
        self._progress = progress
        self._note = note
        self._cache = cache
        self._commands: tuple[list[RecordedCommand], Offset] = [], FIRST_OFFSET
        """Those of the first events, and how many events these are."""
        self._compiled: dict[int, Corrections] = {}
        self._histories: dict[tuple[str, tuple[Offset, ...]], KnownHistory] = {}

    def __enter__(self) -> "LogTimeline":
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    @property
    def end(self) -> Offset:
        """The number of events in the log as of opening or the last `refresh`."""
        return self.reader.next_offset

    def refresh(self) -> Offset:
        """Include events recorded since; returns the new `end`."""
        return self.reader.refresh()

    def commands(
        self, start: Offset = FIRST_OFFSET, end: Offset | None = None
    ) -> list[RecordedCommand]:
        """The commands recorded from ``start`` to before ``end``, undone ones too."""
        commands, known = self._commands
        last = self.end if end is None else end
        if known < last:
            commands = commands + read_commands(self.reader, last, known)
            self._commands = commands, last
        return [recorded for recorded in commands if start <= recorded.offset < last]

    def corrections(self, known_at: Offset | None = None) -> Corrections:
        """The corrections compiled from the commands before ``known_at``, from all for None."""
        commands = self.commands(end=checked_end(self.reader, known_at))
        if len(commands) not in self._compiled:
            for oldest in list(self._compiled)[: 1 - _MOST_COMPILED]:
                del self._compiled[oldest]
            self._compiled[len(commands)] = compile_corrections(commands)
        return self._compiled[len(commands)]

    def knowing(self, known_at: Offset | None = None) -> KnownHistory:
        """The history under the commands before ``known_at``, all of them for None.

        The same commands in force give the same history.
        """
        corrections = self.corrections(known_at)
        settings = self._settings_under(corrections)
        # By the commands in force, not by what they compile to: `why` names every one.
        key = settings.fingerprint(), tuple(command.offset for command in corrections.in_force)
        found = self._histories.pop(key, None) or KnownHistory(
            self.reader,
            settings,
            corrections,
            progress=self._progress,
            note=self._note,
            cache=self._cache,
        )
        self._histories[key] = found  # in order of last use
        for old in list(self._histories)[: -self._most]:
            del self._histories[old]
        return found

    @property
    def settings(self) -> Settings:
        """The settings under all commands of the log."""
        return self._settings_under(self.corrections())

    @property
    def history(self) -> History:
        """The history up to `end` under all commands of the log."""
        return self.knowing().history

    def at(self, end: Offset | None = None, *, known_at: Offset | None = None) -> MapView:
        """The map after the first ``end`` events, all of them for None; see `KnownHistory.at`."""
        return self._known(end, known_at).at(end)

    def deltas(
        self,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        known_at: Offset | None = None,
    ) -> Iterator[FoldedEvent]:
        """The deltas of each event from ``start`` to before ``end``."""
        return self._known(end, known_at).deltas(start, end)

    def merges(self, end: Offset | None = None, *, known_at: Offset | None = None) -> list[Merge]:
        """Every merge of places by the first ``end`` events, in order."""
        return self._known(end, known_at).merges(end)

    def why(
        self, thing: str, end: Offset | None = None, *, known_at: Offset | None = None
    ) -> Explanation:
        """The history of a place or an object; raises NoSuchThing with the nearest names."""
        return self._known(end, known_at).why(thing, end)

    def why_same(
        self,
        first: str,
        second: str,
        end: Offset | None = None,
        *,
        known_at: Offset | None = None,
    ) -> Explanation:
        """Since when, and by which merges, two keyframes (``run:keyframe``) are in one place."""
        return self._known(end, known_at).why_same(first, second, end)

    def diff(
        self, start: Offset, end: Offset | None = None, *, known_at: Offset | None = None
    ) -> Difference:
        """The difference between the maps after ``start`` and after ``end`` events, each under the
        commands before it, or both under those before ``known_at``."""
        last, first = checked_end(self.reader, end), checked_end(self.reader, start)
        known = [at if known_at is None else known_at for at in (first, last)]
        before, after = self.knowing(known[0]).at(start), self.knowing(known[1]).at(last)
        absorbed = self._absorbed(before, last, known[1]) if start <= last else {}
        return difference_of(before, after, absorbed, self.commands(min(known), max(known)))

    def changes(
        self,
        since: Offset | None = None,
        end: Offset | None = None,
        *,
        known_at: Offset | None = None,
    ) -> MapChanges:
        """What changed in the building between two maps, both under the commands before the second
        one, so that no correction is a change; by default since the last run began.

        Raises MisuseError for a map that is not folded by evidence, and where ``since`` is later.
        """
        last = checked_end(self.reader, end)
        known = self._known(last, known_at)
        after = known.at(last)
        if after.settings.fusion != "evidence":
            if self.settings.fusion == "evidence":
                known_end = last if known_at is None else known_at
                raise MisuseError(
                    f"as known after {known_end:,} events the map has no fusion by evidence, which"
                    " the log states later; ask until a later moment, or with a later --known-at"
                )
            raise MisuseError(
                "only a map with fusion by evidence knows what has changed; fold it with"
                " --preset full"
            )
        first = last_run_start(after) if since is None else checked_end(self.reader, since)
        if first > last:
            raise MisuseError(f"since is {first:,}, later than until, {last:,}; exchange them")
        return map_changes(known.at(first), after)

    def moment(self, text: str, *, is_end: bool, note: Note | None = None) -> Offset:
        """The number of events before a moment: a day begins or ends then, a run's first event is
        not yet there or its last one is, or it is a point as of `eventsrc.log.seek.resolve`."""
        if _DAY.fullmatch(text):
            text = f"{text}T23:59:59.999999Z" if is_end else text
        elif not text.isdecimal() and text != "end":
            span = run_span(view := self.at(), text)
            if span is not None:
                return span[is_end]
            if time_of(text) is None and ":" not in text:
                raise NoSuchThing("run", text, [run.run_id for run in view.runs], advice=_MOMENTS)
        return resolve(self.reader, text, note=note)

    def facts(self, end: Offset | None = None, *, known_at: Offset | None = None) -> HistoryFacts:
        """The map after ``end`` events, for evaluating conditions."""
        return self._known(end, known_at).facts(end)

    def bisect(
        self,
        expression: Expression | str,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        scan: bool = False,
        known_at: Offset | None = None,
    ) -> Search:
        """The first event from ``start`` on that made a condition true; with ``scan``, all turns.

        Raises ExpressionError for a text that cannot be read or names what is not in the log.
        """
        return self._known(end, known_at).bisect(expression, start, end, scan=scan)

    def _known(self, end: Offset | None, known_at: Offset | None) -> KnownHistory:
        return self.knowing(checked_end(self.reader, end) if known_at is None else known_at)

    def _settings_under(self, corrections: Corrections) -> Settings:
        if self._settings is None:
            return corrections.settings or Settings()
        return (
            self._settings if isinstance(self._settings, Settings) else self._settings(corrections)
        )

    def _absorbed(
        self, before: MapView, end: Offset, known_at: Offset
    ) -> dict[str, tuple[str, Cause]]:
        """For each place of ``before`` that is absorbed after ``end`` events, by id: its survivor
        and the cause. A command may put that merge before ``before``, so all merges are searched; a
        place is the same in both maps if its founder is."""
        history = self.knowing(known_at).covering(end)
        founders = {p.place_id: before.keyframes[p.founder].offset for p in before.places.values()}
        return {
            place_name(history, place): (place_name(history, merge.survivor), merge.cause)
            for merge in history.merges
            if merge.cause.offset < end
            for place in merge.absorbed
            if founders.get(place_name(history, place))
            == history.keyframes[history.places[place].formed.founder].offset
        }
