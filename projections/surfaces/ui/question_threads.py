"""The service of the page: the log's map under its own settings, and under a few others.

Answers are made on three threads: one for the log's own map, one for maps under other settings and
for answers whose folds take long, one for answers that read the log and fold nothing. The first
fold begins at once on the first of them. A fold is stopped when no client waits for it any more.
"""

import resource
import sys
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from contextlib import ExitStack
from time import perf_counter
from typing import Any, Final, Self, TypeVar

from eventsrc.base.errors import LogError, MapfoldError
from eventsrc.base.text import visible
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from projections.fold.corrections import Corrections
from projections.fold.settings import Settings
from projections.map.place_regions import wall_segments
from projections.surfaces.serve import FairQueue
from projections.surfaces.serve.answering import TooMuchError

from .localizing import Localizer
from .log_map import MOST_ALTERNATIVES, MOST_HISTORIES, LogMap, Opened

_KIB: Final = 1 if sys.platform == "darwin" else 1024
"""The unit of ``ru_maxrss``, bytes."""


def log_document(opened: Opened, shown: LogMap, *, folded: bool = True) -> dict[str, Any]:
    """JSON. Before the log is ``folded`` it names no runs and no problems."""
    corrections = shown.timeline.corrections() if folded else Corrections()
    settings = opened.settings(corrections)
    return {
        "name": shown.reader.path.name,
        "path": str(shown.reader.path),
        "log_id": shown.log_id,
        "events": shown.reader.next_offset,
        "through": shown.through if folded else 0,
        "state": shown.key if folded else "",
        "runs": _runs(shown) if folded else [],
        "settings": settings.by_name(),
        "changed_settings": settings.changed_from(Settings()),
        "fingerprint": settings.fingerprint(),
        "corrections": corrections.fingerprint(),
        "fusion": settings.fusion,
        "places_rule": settings.places,
        "places_text": settings.places_text(),
        "edits_allowed": opened.edits,
        "token_needed": opened.token_needed,
        "losses": shown.log_events.losses,
        "rejected": shown.log_events.rejected,
        "walls": _walls(shown) if folded else [],
        "maps": _maps(shown) if folded else [],
        "problems": [visible(each) for each in shown.problems] if folded else [],
    }


def memory_document() -> dict[str, Any]:
    """The peak memory of the server, and the number of maps that it keeps."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _KIB
    most = MOST_HISTORIES + MOST_ALTERNATIVES
    return {
        "peak_bytes": peak,
        "most_maps": most,
        "text": f"{peak / 2**20:,.0f} MiB at most so far; at most {most} maps are kept",
    }


def _walls(shown: LogMap) -> list[list[float]]:
    """The walls of the occupancy maps in force at the end of the log, of all floors."""
    last = {given.map.floor: given.map for given in shown.timeline.history.maps}
    return [segment for each in last.values() for segment in wall_segments(each)]


def _maps(shown: LogMap) -> list[dict[str, Any]]:
    """The occupancy maps that the log was given, with the floor that each names."""
    given = shown.timeline.history.maps
    return [{"offset": each.offset, "floor": each.map.floor} for each in given]


def _runs(shown: LogMap) -> list[dict[str, Any]]:
    history = shown.timeline.history
    keyframes = [0] * len(history.runs)
    first: dict[int, int] = {}
    for keyframe in history.keyframes:
        keyframes[keyframe.run] += 1
        first.setdefault(keyframe.run, keyframe.offset)
    return [
        {"run_id": seen[0].run_id, "first_offset": first[run], "keyframes": keyframes[run]}
        for run, seen in enumerate(history.runs)
    ]


Result = TypeVar("Result")

_MAX_WAIT_S: Final = 900.0
"""Questions wait for the first fold of a long log."""
_PAGES: Final = "pages"
_WATCH: Final = "watch"

GoOn = Callable[[], None]
"""A function called during work. Raises GivenUp when no client waits for the answer any more."""


class GivenUp(TooMuchError):
    """An answer was abandoned: the page asked for something else or was closed, or the program
    ends."""


class Loading:
    """The progress of the first fold, written by the folding thread and read by all others."""

    def __init__(self) -> None:
        self._folded, self._events = 0, 0
        self.is_done = False

    def show(self, folded: int, events: int) -> None:
        """Called while events are folded."""
        self._folded, self._events = folded, events

    def finish(self) -> None:
        """The log is folded once."""
        self.is_done = True

    def document(self) -> dict[str, Any]:
        """JSON."""
        return {"done": self.is_done, "folded": self._folded, "events": self._events}


class _Thread:
    """A thread that answers one question at a time."""

    def __init__(self, ending: threading.Event) -> None:
        self._queue = FairQueue(1, max_wait_s=_MAX_WAIT_S)
        self._ending = ending
        self._wanted = _always

    def submit(
        self, work: Callable[[], Result], wanted: Callable[[], bool], peer: str = _PAGES
    ) -> "Future[Result]":
        """Do ``work`` in turn. It is not begun if it is not ``wanted`` any more."""

        def begin() -> Result:
            self._wanted = wanted
            self.go_on()
            return work()

        return self._queue.submit(peer, begin)

    def go_on(self) -> None:
        """Raises GivenUp if the answer under way is not wanted any more."""
        if self._ending.is_set():
            raise GivenUp("mapfold ui ends; start it again and ask again")
        if not self._wanted():
            raise GivenUp("no client waits for the answer any more")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.close()


def _always() -> bool:
    return True


class UiService:
    """Opens a log and answers about it; use it in a ``with`` block. Raises LogError."""

    def __init__(self, opened: Opened) -> None:
        self.opened = opened
        self.loading = Loading()
        self.localizer = Localizer(opened)
        self._stack = ExitStack()
        self._alternatives: OrderedDict[tuple[str, ...], LogMap] = OrderedDict()
        self._ending = threading.Event()
        self._map = self._stack.enter_context(LogMap(opened, progress=self._show_progress))
        self._document = log_document(self.opened, self._map, folded=False)
        self._through = FIRST_OFFSET
        self._own = self._stack.enter_context(_Thread(self._ending))
        self._others = self._stack.enter_context(_Thread(self._ending))
        self._reading = self._stack.enter_context(_Thread(self._ending))
        self._loaded = self._own.submit(self._load, _always, _WATCH)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()
        self._stack.close()
        for each in self._alternatives.values():
            each.reader.close()

    def end(self) -> None:
        """Give up all answers, those under way too. May be called twice."""
        self._ending.set()

    @property
    def log_id(self) -> str:
        """The log's id."""
        return self._map.log_id

    def log_document(self) -> dict[str, Any]:
        """The answer of ``/api/log`` as of the last refresh; returns at once."""
        now = {"memory": memory_document(), "loading": self.loading.document()}
        return self._document | now

    def ask(
        self,
        sets: Sequence[str],
        work: Callable[[LogMap, float], Result],
        wanted: Callable[[], bool] = _always,
    ) -> "Future[Result]":
        """Run ``work`` with the map under the log's settings, changed by ``sets``, and the seconds
        that folding it took. A fold is stopped once the answer is not ``wanted`` any more, and
        continued at the next such question."""
        key = tuple(sets)
        if not key:
            return self._own.submit(lambda: work(self._map, 0.0), wanted)
        return self._others.submit(lambda: work(*self._alternative(key)), wanted)

    def ask_apart(
        self,
        work: Callable[[Offset, GoOn], Result],
        wanted: Callable[[], bool] = _always,
        *,
        folds: bool = True,
    ) -> "Future[Result]":
        """Run ``work`` that reads the log itself, beside the questions to the map; it gets the
        number of events that answers cover, and a function to call while it works. What ``folds``
        takes long; what does not waits for no fold but the first."""
        thread = self._others if folds else self._reading

        def asked() -> Result:
            wait([self._loaded])
            self._check_there()
            return work(self._through, thread.go_on)

        return thread.submit(asked, wanted)

    def refresh(self) -> "Future[bool]":
        """Look for new events; the result is whether there are any, or another problem."""
        return self._own.submit(self._refresh, _always, _WATCH)

    def _show_progress(self, folded: int, events: int) -> None:
        self.loading.show(folded, events)
        self._own.go_on()

    def _load(self) -> None:
        try:
            self._refresh()
        finally:
            self.loading.finish()

    def _refresh(self) -> bool:
        try:
            changed = self._map.refresh()
            if changed or not self.loading.is_done:
                self._document = log_document(self.opened, self._map)
                self._through = self._map.through
        except MapfoldError as error:
            self._document |= {"problems": [visible(str(error))]}
            raise
        except Exception as error:
            text = f"the page does not follow the log any more: {error!r}; see the program's stderr"
            self._document |= {"problems": [visible(text)]}
            raise
        return changed

    def _alternative(self, sets: tuple[str, ...]) -> tuple[LogMap, float]:
        """The map under other settings, as far as the log's own map is."""
        wait([self._loaded])
        started = perf_counter()
        found = self._alternatives.pop(sets, None)
        if found is None:
            found = self._open_alternative(sets)
        self._alternatives[sets] = found
        while len(self._alternatives) > MOST_ALTERNATIVES:
            self._alternatives.popitem(last=False)[1].reader.close()
        found.refresh(self._through)
        return found, perf_counter() - started

    def _open_alternative(self, sets: tuple[str, ...]) -> LogMap:
        self._check_there()
        found = LogMap(self.opened, sets, progress=lambda *_: self._others.go_on(), histories=1)
        if found.log_id != self.log_id:
            found.reader.close()
            raise LogError(f"there is another log at {self.opened.log} now; start mapfold ui again")
        return found

    def _check_there(self) -> None:
        """Raises LogError if the log cannot be read any more."""
        if self._map.lost is not None:
            raise LogError(self._map.lost)
