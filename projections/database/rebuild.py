"""Rebuild: fold the whole log into shadows, and swap them in for what readers see.

Everything up to the swap happens in *one* transaction per database: creating the shadow, COPY,
indexes, the counts, the checkpoint, the swap. So an interruption at any moment, of any kind, leaves
the old map served and nothing to clean up. What comes after the commit only helps: dropping what
was replaced and the HNSW index of a large table.

One thread a database writes while the fold goes on (`loading_thread`).

Readers name the graph and AGE resolves each label's table by that name, so a reader in the middle
of a statement must not find half of its tables before the swap and half after. Therefore everything
that is replaced, graph and table, is locked exclusively *before* any name moves: a reader that
already has one of the tables is waited for; one that comes later waits at its first table, and
PostgreSQL resolves the name again when it gets the lock.

While we wait with some of the locks in hand, a reader may wait for us: a deadlock. So we wait only
briefly, let go of all of them, and try again; below the server's deadlock_timeout (1 s) it is
always us who give way. That goes for the locks of two databases together: no server sees a deadlock
between them, and the readers of one are not to wait until those of the other have ended.
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
from projections.model.fold import no_cycle_search
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
class StoreRebuild:
    """A store, the shadows of its sinks in their order, and the thread that fills them.

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
        self.thread.put(partial(self.store.do, job))


@contextlib.contextmanager
def _store_rebuilds(stores: list[Store]) -> Iterator[list[StoreRebuild]]:
    """A thread for each store, which begins with creating the shadows."""
    with contextlib.ExitStack() as threads:
        rebuilds = []
        for store in stores:
            thread = threads.enter_context(LoadingThread(partial(_cancel, store.connection)))
            shadows = [sink.shadow() for sink in store.sinks]
            thread.put(partial(_create, store, shadows))
            rebuilds.append(StoreRebuild(store, shadows, thread))
        yield rebuilds


def _cancel(connection: Connection) -> None:
    with contextlib.suppress(psycopg.Error):  # the server is gone, and what it was at with it
        connection.cancel_safe()


def _create(store: Store, shadows: Sequence[Shadow[Connection]]) -> None:
    with store.throwaway_connection() as connection:
        for sink in store.sinks:
            sink.drop_leftovers(connection)
    for shadow in shadows:
        store.do(shadow.create)


ATTEMPT: Final = "SET LOCAL lock_timeout = '200ms'; SET LOCAL statement_timeout = '400ms'"
"""A sink's tables are locked by one statement, which may wait for one reader after the other: both
sinks together stay below a second."""
DONE: Final = "SET LOCAL lock_timeout = 0; SET LOCAL statement_timeout = 0"
PAUSE_S: Final = 0.02
PATIENCE_S: Final = 120.0


def lock_readers(rebuilds: Sequence[StoreRebuild]) -> None:
    """Lock what the shadows will replace. Raises DatabaseError when readers never let go."""
    deadline = time.monotonic() + PATIENCE_S
    while (store := _store_with_readers(rebuilds)) is not None:
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"{store.place}: readers kept the map locked for {PATIENCE_S:.0f} s; end their"
                " transactions, then run the rebuild again"
            )
        time.sleep(PAUSE_S)
    for each in rebuilds:
        each.store.connection.execute(DONE)


class _HasReaders(Exception):
    """A reader has one of the tables."""

    def __init__(self, store: Store) -> None:
        self.store = store


def _store_with_readers(rebuilds: Sequence[StoreRebuild]) -> Store | None:
    """Try once: None when all is locked, else a store whose readers hold locks; then nothing is."""
    try:
        with contextlib.ExitStack() as savepoints:  # rolling back to them releases the locks
            for each in rebuilds:
                with database_errors(each.store.url):
                    savepoints.enter_context(each.store.connection.transaction())
                    _lock(each)
    except _HasReaders as found:
        return found.store
    return None


def _lock(rebuild: StoreRebuild) -> None:
    connection = rebuild.store.connection
    try:
        connection.execute(ATTEMPT)
        for shadow in rebuild.shadows:
            shadow.lock_readers(connection)
    except (psycopg.errors.LockNotAvailable, psycopg.errors.QueryCanceled):
        raise _HasReaders(rebuild.store) from None


TICK_EVENTS: Final = 256
"""Events between two reports of progress and checks of whether enough rows wait to be written."""
STREAM_ROWS: Final = 2_000
"""Keyframes and observations that wait before they are written: enough to make COPY's round trips
vanish, few enough that the server has something to do from early on."""


@dataclass(frozen=True, slots=True)
class RebuildProgress:
    """``done`` of ``total`` events are folded; ``stage`` says what is going on."""

    stage: str
    done: int
    total: int


OnProgress: TypeAlias = Callable[[RebuildProgress], None]


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """What a rebuild did. ``rows`` is by graph label and table; times are seconds.

    ``foreign`` is the first of the embeddings that were left out for their space.
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
    """Fold the first ``until`` events (all for None) and put the result in the databases' place.

    Raises FoldError at an event that cannot be folded, ProjectionBusy beside a tail or another
    rebuild, and DatabaseError; the old map is served on then.
    """
    started = time.monotonic()
    tell = progress or (lambda _: None)
    with (
        no_cycle_search(),
        LogReader(log) as reader,
        open_stores(
            targets, settings, only=only, application="mapfold replay", loader=loader
        ) as stores,
    ):
        total = reader.next_offset if until is None else min(until, reader.next_offset)
        fold = LiveFold(settings)
        with _transactions(stores):
            with short_turns(), _store_rebuilds(stores) as rebuilds:
                events, advice = reader.read(FIRST_OFFSET, total), partial(_advice, log, settings)
                last = _fold_into(fold, events, rebuilds, total, tell, advice)
                folded = time.monotonic()
                tell(RebuildProgress("writing", total, total))
                changes = fold.recorder.drain()
                for each in rebuilds:
                    each.load(changes, fold.view)
                    each.finish(fold.view)
                digest = map_digest(fold.view)
                for each in rebuilds:
                    each.thread.flush()
            checkpoint = Checkpoint(
                reader.log_id,
                settings.fingerprint(),
                settings.model_dump_json(),
                total,
                checkpoints.event_hash(last),
                digest,
            )
            for each in rebuilds:
                each.store.do(partial(_replace_checkpoints, each.store, checkpoint))
            tell(RebuildProgress("swapping", total, total))
            lock_readers(rebuilds)
            for each in rebuilds:
                for shadow in each.shadows:
                    each.store.do(shadow.swap_in)
        tell(RebuildProgress("tidying", total, total))
        with _swapped():
            index = _after(stores, tell, total, hnsw=hnsw)
        ended = time.monotonic()
        return RebuildReport(
            total,
            digest,
            fold.view.counts(),
            {label: rows for each in rebuilds for label, rows in each.rows.items()},
            folded - started,
            ended - started,
            index,
            first_foreign_embedding(fold, reader),
        )


@contextlib.contextmanager
def _transactions(stores: list[Store]) -> Iterator[None]:
    """A transaction in each store, of which either all are committed or, unless one fails, none."""
    with contextlib.ExitStack() as transactions:
        for store in stores:
            transactions.enter_context(database_errors(store.url))
            transactions.enter_context(store.connection.transaction())
        yield


def _fold_into(
    fold: LiveFold,
    events: Iterable[Event],
    rebuilds: list[StoreRebuild],
    total: int,
    tell: OnProgress,
    advice: Callable[[int], str],
) -> Event | None:
    last: Event | None = None
    for batch in batches(events, TICK_EVENTS):
        for failed in fold.feed(batch):
            if failed is not None:
                raise FoldError(failed.offset, f"{failed.reason}; {advice(failed.offset)}")
        last = batch[-1]
        tell(RebuildProgress("folding", last.offset + 1, total))
        if fold.recorder.added >= STREAM_ROWS:
            changes = fold.recorder.drain()
            for each in rebuilds:
                each.load(changes, fold.view)
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
def _swapped() -> Iterator[None]:
    """What fails now leaves nobody with the old map, and should not sound as if it did."""
    try:
        yield
    except DatabaseError as error:
        raise type(error)(f"{error}; the new map is in place all the same") from error


def _after(stores: list[Store], tell: OnProgress, total: int, *, hnsw: bool) -> HnswReport | None:
    index: HnswReport | None = None
    for store in stores:
        for sink in store.sinks:
            with store.throwaway_connection() as connection:
                sink.drop_replaced(connection)
        if hnsw and any(sink.name == "vectors" for sink in store.sinks):
            tell(RebuildProgress("indexing", total, total))
            with store.throwaway_connection() as connection:
                index = build_hnsw(connection)
    return index
