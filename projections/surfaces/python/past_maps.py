"""`Timeline` for scripts and notebooks: maps of one log at any point, and how they came about."""

import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from eventsrc.log.seek import resolve
from projections import history
from projections.ask.what_changed import MapChanges
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.history.merge_reasons import merge_document

from .map import Map, SettingsLike, settings_from

_Method = TypeVar("_Method", bound=Callable[..., Any])


def _one_at_a_time(ask: _Method) -> _Method:
    """A method of `Timeline` for which other threads wait."""

    @functools.wraps(ask)
    def waiting(self: "Timeline", *args: Any, **kwargs: Any) -> Any:
        with self._lock:
            return ask(self, *args, **kwargs)

    return cast("_Method", waiting)


class Timeline:
    """A context manager over a log. A point is a number of events, a time in ISO 8601,
    ``RUN:KEYFRAME`` or ``end``.

    The log is folded once, at the first question, and its history kept in files beside the log
    (``LOG.history``, a cache), unless ``cache`` is false. ``settings`` and ``preset`` are as in
    `fold`. Answers are the documents that the commands print with ``--json``. Raises LogNotFound,
    NotALog, LogDamaged or SettingsError, and MisuseError for a point that the log does not have.

    Several threads may ask one timeline; they are answered one after another. A question that is
    interrupted, by Ctrl-C or the stop button of a notebook, can be asked again.

    Examples:
        >>> with Timeline("logs/sample") as timeline:
        ...     for merge in timeline.merges():
        ...         print(merge["offset"], merge["survivor"], *merge["absorbed"])
        304 sim-7-a_p0 sim-7-a_p4
    """

    def __init__(
        self,
        log: str | Path,
        settings: SettingsLike = None,
        *,
        preset: str | None = None,
        cache: bool = True,
    ) -> None:
        self._lock = threading.RLock()
        self._log = Path(log)
        self._chosen = settings_from(settings, preset)
        self._timeline = history.LogTimeline(self._log, self._settings, cache=cache)

    def __repr__(self) -> str:
        return f"<Timeline of {self._log}: {counted(self._timeline.reader.readable_end, 'event')}>"

    def __enter__(self) -> "Timeline":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @_one_at_a_time
    def close(self) -> None:
        """Close the log."""
        self._timeline.reader.close()

    @property
    def end(self) -> int:
        """The number of events as of opening or the last `refresh`."""
        return self._timeline.end

    @_one_at_a_time
    def refresh(self) -> int:
        """Include the events recorded since; returns the new `end`."""
        return self._timeline.refresh()

    @_one_at_a_time
    def at(self, point: int | str = "end") -> Map:
        """The map at a point. It has no embeddings: ask a map of `fold` by `relocalize`."""
        end = self._offset(point)
        return Map(self._timeline.at(end), end, self._timeline.reader.path)

    @_one_at_a_time
    def merges(self, point: int | str = "end") -> list[dict[str, Any]]:
        """Every merge of places up to a point, as ``mapfold merges --json``."""
        end = self._offset(point)
        known = self._timeline.knowing(end)
        return [merge_document(known.covering(end), each) for each in known.merges(end)]

    @_one_at_a_time
    def why(self, thing: str, point: int | str = "end") -> dict[str, Any]:
        """The history of a place or an object, as ``mapfold why --json``.

        It may be named as in `Map.place` and `Map.object`. Raises NoSuchThing with the nearest
        names, and SeveralThings.
        """
        return self._timeline.why(thing, self._offset(point)).document()

    @_one_at_a_time
    def why_same(self, first: str, second: str, point: int | str = "end") -> dict[str, Any]:
        """Since when, and by which merges, two keyframes (``RUN:KEYFRAME``) are in one place."""
        return self._timeline.why_same(first, second, self._offset(point)).document()

    @_one_at_a_time
    def diff(self, start: int | str, end: int | str = "end") -> dict[str, Any]:
        """The difference between the maps at two points, as ``mapfold diff --json``."""
        return self._timeline.diff(self._offset(start), self._offset(end)).document()

    @_one_at_a_time
    def changes(self, since: str | None = None, until: str = "end") -> MapChanges:
        """What changed in the building for sure: since a day, a run or another point, by default
        since the last run began, until the end of another."""
        end = self._timeline.moment(until, is_end=True)
        start = None if since is None else self._timeline.moment(since, is_end=False)
        return self._timeline.changes(start, end)

    @_one_at_a_time
    def bisect(
        self, condition: str, start: int | str = 0, end: int | str = "end"
    ) -> dict[str, Any]:
        """The first event that made a condition true, as ``mapfold bisect --json``.

        Raises ExpressionError for a condition that cannot be read.

        Examples:
            >>> with Timeline("logs/sample") as timeline:
            ...     timeline.bisect("object_count >= 40")["found"]["offset"]
            163
        """
        found = self._timeline.bisect(condition, self._offset(start), self._offset(end))
        return found.document()

    def whatif(self, *alternatives: SettingsLike, point: int | str = "end") -> dict[str, Any]:
        """The map under other settings beside this one, as ``mapfold whatif --json``.

        Each alternative is a whole set of settings, as in `fold`.
        """
        with self._lock:
            end = self._offset(point)
            corrections = self._timeline.corrections(end)
        others = [settings_from(each)(corrections) for each in alternatives]
        base = self._chosen(corrections)
        return history.what_if(self._log, base, others, end, processes=1).document()

    def _offset(self, point: int | str) -> Offset:
        return resolve(self._timeline.reader, str(point))

    def _settings(self, corrections: Corrections) -> Settings:
        return self._chosen(corrections)
