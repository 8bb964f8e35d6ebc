"""The log that a page shows: its map under the log's own settings, and under a few others.

Answers are made on two threads: one for the log's own map, one for maps under other settings, whose
folds may take long. The first fold begins at once on the first of them.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from time import perf_counter
from typing import Any, Final, Self, TypeVar

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.errors import LogError, MapfoldError
from projections.serve import FairQueue

from .localizing import Localizer
from .log_document import log_document, memory_document
from .log_map import MOST_ALTERNATIVES, LogMap
from .opened import Opened
from .progress import Loading

Result = TypeVar("Result")

_MAX_WAIT_S: Final = 900.0
"""Questions wait for the first fold of a long log."""
_PEER: Final = "page"


class GivenUp(MapfoldError):
    """A fold was given up because the page asked for something else."""


class UiService:
    """Opens a log and answers about it; use it in a ``with`` block. Raises LogError."""

    def __init__(self, opened: Opened) -> None:
        self.opened = opened
        self.loading = Loading()
        self.localizer = Localizer(opened)
        self._stack = ExitStack()
        self._alternatives: OrderedDict[tuple[str, ...], LogMap] = OrderedDict()
        self._map = self._stack.enter_context(LogMap(opened, progress=self.loading.show))
        self._document = log_document(self.opened, self._map, folded=False)
        self._through = FIRST_OFFSET
        self._wanted: Callable[[], bool] = lambda: True
        self._own = self._stack.enter_context(FairQueue(1, max_wait_s=_MAX_WAIT_S))
        self._others = self._stack.enter_context(FairQueue(1, max_wait_s=_MAX_WAIT_S))
        self._loaded = self._own.submit(_PEER, self._load)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        for each in self._alternatives.values():
            each.reader.close()

    @property
    def log_id(self) -> str:
        """The log's id."""
        return self._map.log_id

    def log_document(self) -> dict[str, Any]:
        """What ``/api/log`` answers, at once: as of the last refresh."""
        now = {"memory": memory_document(), "loading": self.loading.document()}
        return self._document | now

    def ask(
        self,
        sets: Sequence[str],
        work: Callable[[LogMap, float], Result],
        wanted: Callable[[], bool] = lambda: True,
    ) -> "Future[Result]":
        """``work`` with the map under the log's settings, changed by ``sets``, and the seconds that
        folding it took just now. A fold under other settings is given up, to be continued when it
        is asked for again, once the answer is not ``wanted`` any more."""
        key = tuple(sets)
        if not key:
            return self._own.submit(_PEER, lambda: work(self._map, 0.0))
        return self._others.submit(_PEER, lambda: work(*self._alternative(key, wanted)))

    def ask_apart(self, work: Callable[[Offset], Result]) -> "Future[Result]":
        """``work`` that reads the log itself and takes long, with the number of events that answers
        cover."""

        def asked() -> Result:
            self._loaded.result()
            if self._map.lost is not None:
                raise LogError(self._map.lost)
            return work(self._through)

        return self._others.submit(_PEER, asked)

    def refresh(self) -> "Future[bool]":
        """Look for events recorded since; whether there are any, or another problem."""
        return self._own.submit(_PEER, self._refresh)

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
            self._document |= {"problems": [str(error)]}
            raise
        return changed

    def _alternative(
        self, sets: tuple[str, ...], wanted: Callable[[], bool]
    ) -> tuple[LogMap, float]:
        """The map under other settings, as far as the log's own map is."""
        self._loaded.result()
        started = perf_counter()
        found = self._alternatives.pop(sets, None)
        if found is None:
            found = LogMap(self.opened, sets, progress=self._go_on, histories=1)
        self._alternatives[sets] = found
        while len(self._alternatives) > MOST_ALTERNATIVES:
            self._alternatives.popitem(last=False)[1].reader.close()
        self._wanted = wanted
        self._go_on(0, 0)
        found.refresh(self._through)
        return found, perf_counter() - started

    def _go_on(self, _folded: int, _events: int) -> None:
        """Called while a map under other settings is folded."""
        if not self._wanted():
            raise GivenUp("nobody waits for the answer any more")
