"""Rebuild: fold the whole log into shadows, and swap them in for the map that readers see.

Creating the shadow, COPY, indexes, comparing numbers, the checkpoint and the swap are *one*
transaction per database. So an interruption of any kind at any moment leaves the old map in place
and nothing to clean up. After the commit only what was replaced is dropped and, for a large table,
the HNSW index built. A thread for each database writes while the fold goes on (`loading_thread`).

Readers name the graph and AGE resolves each label's table by that name, so a reader in the middle
of a statement must not find half of its tables before the swap and half after. Therefore everything
that is replaced, graph and table, is locked exclusively *before* any name changes: we wait for a
reader that already has one of the tables; one that comes later waits at its first table, and
PostgreSQL resolves the name again when it gets the lock.

While we wait and hold some of the locks, a reader may wait for us: a deadlock. So we wait only
briefly, release all of them, and try again; below the server's deadlock_timeout (1 s) it is always
we who give way. The locks of two databases are taken and released together: no server sees a
deadlock between them, and the readers of one must not wait until those of the other have ended.
"""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final, TypeAlias

import psycopg

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.errors import DatabaseError, FoldError
from projections.model.changes import BatchChanges
from projections.model.digest import map_digest
from projections.model.fold import gc_paused
from projections.model.view import MapView
from projections.settings import Settings

from . import checkpoints
from .connection import Connection, Targets, database_errors
from .foreign_embedding import ForeignEmbedding, first_foreign_embedding
from .live_fold import LiveFold, batches
from .loader import LoaderName
from .loading_thread import LoadingThread, short_turns
from .origin import command_line
from .sink import Checkpoint, Shadow
from .stores import Only, Store, open_stores
from .vector_table import HnswReport, build_hnsw


@dataclass(frozen=True, slots=True)
class ShadowWriter:
    """Writes the shadows of a store's sinks, which are in their order, in a thread.

    ``rows`` is the number of rows by label or table, once a shadow is finished.
    """

    store: Store
    shadows: list[Shadow[Connection]]
    thread: LoadingThread
    rows: dict[str, int] = field(default_factory=dict)

    def load(self, changes: BatchChanges, view: MapView) -> None:
        """Have the thread write the rows of new keyframes and observations."""
        for shadow in self.shadows:
            self._put(shadow.load(changes, view))

    def finish(self, view: MapView) -> None:
        """Have the thread write all other rows, index them and compare their numbers."""
        for shadow in self.shadows:
            self._put(partial(self._finish, shadow.finish(view)))

    def _finish(
        self, finish: Callable[[Connection], Mapping[str, int]], connection: Connection
    ) -> None:
        self.rows.update(finish(connection))

    def _put(self, job: Callable[[Connection], None]) -> None:
        self.thread.put(partial(self.store.run, job))


@contextlib.contextmanager
def _shadow_writers(stores: list[Store]) -> Iterator[list[ShadowWriter]]:
    """A thread for each store, which begins with creating the shadows."""
    with contextlib.ExitStack() as threads:
        writers = []
        for store in stores:
            thread = threads.enter_context(LoadingThread(partial(_cancel, store.connection)))
            shadows = [sink.shadow() for sink in store.sinks]
            thread.put(partial(_create, store, shadows))
            writers.append(ShadowWriter(store, shadows, thread))
        yield writers


def _cancel(connection: Connection) -> None:
    with contextlib.suppress(psycopg.Error):  # the server is gone, nothing is left to cancel
        connection.cancel_safe()


def _create(store: Store, shadows: Sequence[Shadow[Connection]]) -> None:
    with store.throwaway_connection() as connection:
        for sink in store.sinks:
            sink.drop_leftovers(connection)
    for shadow in shadows:
        store.run(shadow.create)


SHORT_TIMEOUTS: Final = "SET LOCAL lock_timeout = '200ms'; SET LOCAL statement_timeout = '400ms'"
"""For one attempt to lock. A sink's tables are locked by one statement, which may wait for several
readers in turn: both sinks together stay below a second."""
NO_TIMEOUTS: Final = "SET LOCAL lock_timeout = 0; SET LOCAL statement_timeout = 0"
PAUSE_S: Final = 0.02
PATIENCE_S: Final = 120.0


def lock_readers(writers: Sequence[ShadowWriter]) -> None:
    """Lock what the shadows will replace. Raises DatabaseError after `PATIENCE_S`."""
    deadline = time.monotonic() + PATIENCE_S
    while (store := _store_with_readers(writers)) is not None:
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"{store.place}: readers kept the map locked for {PATIENCE_S:.0f} s; end their"
                " transactions, then run the rebuild again"
            )
        time.sleep(PAUSE_S)
    for writer in writers:
        writer.store.connection.execute(NO_TIMEOUTS)


class _HasReaders(Exception):
    """A reader has one of the tables."""

    def __init__(self, store: Store) -> None:
        self.store = store


def _store_with_readers(writers: Sequence[ShadowWriter]) -> Store | None:
    """Try once: None when all is locked; else nothing is, and readers hold locks in this store."""
    try:
        with contextlib.ExitStack() as savepoints:  # rolling back to them releases the locks
            for writer in writers:
                with database_errors(writer.store.url):
                    savepoints.enter_context(writer.store.connection.transaction())
                    _lock(writer)
    except _HasReaders as found:
        return found.store
    return None


def _lock(writer: ShadowWriter) -> None:
    connection = writer.store.connection
    try:
        connection.execute(SHORT_TIMEOUTS)
        for shadow in writer.shadows:
            shadow.lock_readers(connection)
    except (psycopg.errors.LockNotAvailable, psycopg.errors.QueryCanceled):
        raise _HasReaders(writer.store) from None


TICK_EVENTS: Final = 256
"""Events between two reports of progress and checks of whether enough rows wait to be written."""
STREAM_ROWS: Final = 2_000
"""Keyframes and observations that wait before they are written: enough to make COPY's round trips
vanish, few enough that the server has something to do from early on."""


@dataclass(frozen=True, slots=True)
class RebuildProgress:
    """``done`` of ``total`` events are folded; ``stage`` is what the rebuild does now."""

    stage: str
    done: int
    total: int


OnProgress: TypeAlias = Callable[[RebuildProgress], None]


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """What a rebuild did. ``rows`` is by graph label and table; times are seconds.

    ``foreign`` is the first embedding that was left out because it is outside the map's space.
    """

    events: int
    digest: str
    counts: dict[str, int]
    rows: dict[str, int]
    fold_s: float
    total_s: float
    hnsw: HnswReport | None
    foreign: ForeignEmbedding | None = None


def rebuild(
    log: Path,
    targets: Targets,
    settings: Settings,
    *,
    until: Offset | None = None,
    only: Only = None,
    loader: LoaderName = "copy",
    hnsw: bool = True,
    progress: OnProgress | None = None,
) -> RebuildReport:
    """Fold the first ``until`` events (all for None) and replace the map in the databases.

    Raises FoldError at an event that cannot be folded, ProjectionBusy beside a tail or another
    rebuild, and DatabaseError; the old map stays then.
    """
    started = time.monotonic()
    notify = progress or (lambda _: None)
    with (
        gc_paused(),
        LogReader(log) as reader,
        open_stores(
            targets, settings, only=only, application="mapfold replay", loader=loader
        ) as stores,
    ):
        total = reader.next_offset if until is None else min(until, reader.next_offset)
        fold = LiveFold(settings)
        with _transactions(stores):
            with short_turns(), _shadow_writers(stores) as writers:
                events, advice = reader.read(FIRST_OFFSET, total), partial(_advice, log, settings)
                last = _fold_into(fold, events, writers, total, notify, advice)
                folded = time.monotonic()
                notify(RebuildProgress("writing", total, total))
                changes = fold.tracker.drain()
                for writer in writers:
                    writer.load(changes, fold.view)
                    writer.finish(fold.view)
                digest = map_digest(fold.view)
                for writer in writers:
                    writer.thread.flush()
            checkpoint = Checkpoint(
                reader.log_id,
                settings.fingerprint(),
                settings.model_dump_json(),
                total,
                checkpoints.event_hash(last),
                digest,
            )
            for writer in writers:
                writer.store.run(partial(_replace_checkpoints, writer.store, checkpoint))
            notify(RebuildProgress("swapping", total, total))
            lock_readers(writers)
            for writer in writers:
                for shadow in writer.shadows:
                    writer.store.run(shadow.swap_in)
        notify(RebuildProgress("tidying", total, total))
        with _errors_after_swap():
            index = _drop_replaced(stores, notify, total, hnsw=hnsw)
        ended = time.monotonic()
        return RebuildReport(
            total,
            digest,
            fold.view.counts(),
            {label: rows for writer in writers for label, rows in writer.rows.items()},
            folded - started,
            ended - started,
            index,
            first_foreign_embedding(fold, reader),
        )


@contextlib.contextmanager
def _transactions(stores: list[Store]) -> Iterator[None]:
    """A transaction in each store, committed in turn; an error inside rolls all of them back."""
    with contextlib.ExitStack() as transactions:
        for store in stores:
            transactions.enter_context(database_errors(store.url))
            transactions.enter_context(store.connection.transaction())
        yield


def _fold_into(
    fold: LiveFold,
    events: Iterable[Event],
    writers: list[ShadowWriter],
    total: int,
    notify: OnProgress,
    advice: Callable[[int], str],
) -> Event | None:
    last: Event | None = None
    for batch in batches(events, TICK_EVENTS):
        for failed in fold.feed(batch):
            if failed is not None:
                raise FoldError(failed.offset, f"{failed.reason}; {advice(failed.offset)}")
        last = batch[-1]
        notify(RebuildProgress("folding", last.offset + 1, total))
        if fold.tracker.added >= STREAM_ROWS:
            changes = fold.tracker.drain()
            for writer in writers:
                writer.load(changes, fold.view)
    return last


def _advice(log: Path, settings: Settings, offset: Offset) -> str:
    """What to do about an event that cannot be folded."""
    before = command_line("replay", log, settings, "--until", str(offset))
    return (
        "the databases stay as they were; to leave it out run:"
        f" {before} && {command_line('tail', log, settings)}"
    )


def _replace_checkpoints(store: Store, checkpoint: Checkpoint, connection: Connection) -> None:
    for sink in store.sinks:
        checkpoints.replace(connection, sink.name, checkpoint)


@contextlib.contextmanager
def _errors_after_swap() -> Iterator[None]:
    """Add to a DatabaseError that the new map is in place."""
    try:
        yield
    except DatabaseError as error:
        raise type(error)(f"{error}; the new map is in place all the same") from error


def _drop_replaced(
    stores: list[Store], notify: OnProgress, total: int, *, hnsw: bool
) -> HnswReport | None:
    index: HnswReport | None = None
    for store in stores:
        for sink in store.sinks:
            with store.throwaway_connection() as connection:
                sink.drop_replaced(connection)
        if hnsw and any(sink.name == "vectors" for sink in store.sinks):
            notify(RebuildProgress("indexing", total, total))
            with store.throwaway_connection() as connection:
                index = build_hnsw(connection)
    return index
