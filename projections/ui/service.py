"""The log that a page shows: its map under the log's own settings, and under a few others.

Answers are made on two threads: one for the log's own map, one for maps under other settings, whose
folds may take long. The first fold begins at once on the first of them.
"""

from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any, Final, Self, TypeVar

from projections.corrections import Corrections
from projections.history.timeline import SettingsChoice
from projections.serve import FairQueue
from projections.settings import Settings

from .log_document import Access, log_document
from .log_map import MOST_ALTERNATIVES, LogMap
from .progress import Loading

Result = TypeVar("Result")

_MAX_WAIT_S: Final = 900.0
"""Questions wait for the first fold of a long log."""
_PEER: Final = "page"


class UiService:
    """Opens a log and answers about it; use it in a ``with`` block. Raises LogError.

    ``settings`` gives the settings under some corrections.
    """

    def __init__(self, log: Path, settings: SettingsChoice, access: Access) -> None:
        self.path = log
        self.access = access
        self.loading = Loading()
        self._settings = settings
        self._stack = ExitStack()
        self._alternatives: OrderedDict[tuple[str, ...], LogMap] = OrderedDict()
        self._map = self._stack.enter_context(LogMap(log, settings, progress=self.loading.show))
        self._document = log_document(self.access, self._map, folded=False)
        self._own = self._stack.enter_context(FairQueue(1, max_wait_s=_MAX_WAIT_S))
        self._others = self._stack.enter_context(FairQueue(1, max_wait_s=_MAX_WAIT_S))
        self._own.submit(_PEER, self._load)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
        for each in self._alternatives.values():
            each.reader.close()

    def log_document(self) -> dict[str, Any]:
        """What ``/api/log`` answers, at once: as of the last refresh."""
        return self._document | {"loading": self.loading.document()}

    def ask(self, sets: Sequence[str], work: Callable[[LogMap, float], Result]) -> "Future[Result]":
        """``work`` with the map under the log's settings, changed by ``sets``, and the seconds that
        folding it took just now."""
        key = tuple(sets)
        if not key:
            return self._own.submit(_PEER, lambda: work(self._map, 0.0))
        return self._others.submit(_PEER, lambda: work(*self._alternative(key)))

    def refresh(self) -> "Future[bool]":
        """Look for events recorded since; whether there are any, or another problem."""
        return self._own.submit(_PEER, self._refresh)

    def _load(self) -> None:
        self._map.refresh()
        self._document = log_document(self.access, self._map)
        self.loading.finish()

    def _refresh(self) -> bool:
        changed = self._map.refresh()
        if changed:
            self._document = log_document(self.access, self._map)
        return changed

    def _alternative(self, sets: tuple[str, ...]) -> tuple[LogMap, float]:
        """The map under other settings, as far as the log's own map is."""
        started = perf_counter()
        found = self._alternatives.pop(sets, None)
        if found is None:

            def settings(corrections: Corrections) -> Settings:
                return self._settings(corrections).with_assignments(sets, "set")

            found = LogMap(self.path, settings, histories=1)
        self._alternatives[sets] = found
        while len(self._alternatives) > MOST_ALTERNATIVES:
            self._alternatives.popitem(last=False)[1].reader.close()
        found.refresh(self._map.through)
        return found, perf_counter() - started
