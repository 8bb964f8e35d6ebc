"""Folding one log under several settings at once, on several processes.

Each process reads and validates the log once and feeds all of its settings from that, so reading is
paid once per process and not once per setting. Few events are folded here and now: starting
a process takes longer than they do.
"""

import multiprocessing
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.errors import MapfoldError
from eventsrc.log import Event, LogReader
from projections.deltas import KeyframeAdded, KeyframePlaced, PlaceFormed, PlacesMerged
from projections.evaluate.truth import Truth
from projections.model.fold import AHEAD, ReadEvent, fold_read, no_cycle_search, read_together
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

from .history import History
from .outcome import Outcome, outcome_of

Progress = Callable[[int, int], None]

WORTH_A_PROCESS = 20_000
"""Events times settings from which processes are started: about two seconds of folding."""
_POLL_S = 0.2
_OF_PLACES = frozenset({KeyframeAdded, PlaceFormed, KeyframePlaced, PlacesMerged})
"""What a comparison of histories needs; the view knows the rest."""

_done: "Synchronized[int] | None" = None
"""In a worker process: events folded by all of them together."""


def fold_all(
    log: Path,
    settings: Sequence[Settings],
    end: Offset,
    *,
    truth: Truth | None = None,
    processes: int | None = None,
    progress: Progress | None = None,
    keep_views: bool = False,
) -> list[Outcome]:
    """The outcome of the first ``end`` events under each of ``settings``, in their order.

    With ``keep_views`` each has its map too, without embeddings. Raises FoldError at an event that
    cannot be folded.
    """
    workers = min(processes or _processors(), len(settings))
    if workers <= 1 or (processes is None and end * len(settings) < WORTH_A_PROCESS):
        return fold_several(log, settings, end, truth, progress, keep_views=keep_views)
    shares = [list(settings[index::workers]) for index in range(workers)]
    outcomes = _in_processes(log, shares, end, truth, progress, keep_views=keep_views)
    return [outcomes[index % workers][index // workers] for index in range(len(settings))]


def fold_several(
    log: Path,
    settings: Sequence[Settings],
    end: Offset,
    truth: Truth | None = None,
    progress: Progress | None = None,
    *,
    keep_views: bool = False,
) -> list[Outcome]:
    """The same in this process: one pass over the log for all of ``settings``."""
    folds = [_Fold(each) for each in settings]
    with LogReader(log) as reader:
        events = reader.read(FIRST_OFFSET, end)
        with no_cycle_search():
            while chunk := list(islice(events, AHEAD)):
                _fold_chunk(chunk, folds)
                if progress is not None:
                    progress(chunk[-1].offset + 1, end)
            return [fold.outcome(truth, keep_view=keep_views) for fold in folds]


class _Fold:
    """One setting's map, view and history, and the time they took."""

    def __init__(self, settings: Settings) -> None:
        self.map = SemanticMap(settings)
        self.view = MapView(settings, keep_embeddings=False)
        self.history = History(settings)
        self.seconds = 0.0

    def take(self, read: ReadEvent) -> None:
        """Fold one event."""
        offset, deltas = read.offset, fold_read(read, self.map)
        self.view.apply_event(offset, deltas)
        self.history.apply(offset, [delta for delta in deltas if type(delta) in _OF_PLACES])

    def outcome(self, truth: Truth | None, *, keep_view: bool) -> Outcome:
        outcome = outcome_of(self.view, self.history, truth, self.seconds)
        return replace(outcome, view=self.view) if keep_view else outcome


def _fold_chunk(chunk: Sequence[Event], folds: Sequence[_Fold]) -> None:
    """As `projections.model.fold.fold_events`, reading and validating once for all folds."""
    read = read_together(chunk)
    for fold in folds:
        started = time.perf_counter()
        for event in read:
            fold.take(event)
        fold.seconds += time.perf_counter() - started


def _in_processes(
    log: Path,
    shares: list[list[Settings]],
    end: Offset,
    truth: Truth | None,
    progress: Progress | None,
    *,
    keep_views: bool,
) -> list[list[Outcome]]:
    # Spawned, not forked: the caller may have threads (a writer, a Zenoh session) whose locks a
    # fork would copy in whatever state they are.
    context = multiprocessing.get_context("spawn")
    done = context.Value("q", 0)
    with ProcessPoolExecutor(
        len(shares), mp_context=context, initializer=_start_worker, initargs=(done,)
    ) as pool:
        with _no_ctrl_c():
            futures = [pool.submit(_work, log, each, end, truth, keep_views) for each in shares]
        _watch(futures, done, end * len(shares), progress)
        try:
            return [future.result() for future in futures]
        except BrokenProcessPool:
            raise MapfoldError(
                f"{log}: a process that folded it was killed, perhaps for want of memory; "
                "try fewer --processes"
            ) from None


@contextmanager
def _no_ctrl_c() -> Iterator[None]:
    """Hold Ctrl-C back: what is started inside does so too, until it says what is to happen."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _start_worker(done: "Synchronized[int]") -> None:
    global _done
    _done = done
    # Ctrl-C reaches the whole group: the parent says so, its workers just end.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def _work(
    log: Path, settings: list[Settings], end: Offset, truth: Truth | None, keep_views: bool
) -> list[Outcome]:
    counted = 0

    def report(folded: int, _: int) -> None:
        nonlocal counted
        if _done is not None:
            with _done.get_lock():
                _done.value += folded - counted
        counted = folded

    return fold_several(log, settings, end, truth, report, keep_views=keep_views)


def _watch(
    futures: "list[Future[list[Outcome]]]",
    done: "Synchronized[int]",
    total: int,
    progress: Progress | None,
) -> None:
    while wait(futures, timeout=_POLL_S).not_done:
        if progress is not None:
            progress(done.value, total)


def _processors() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
