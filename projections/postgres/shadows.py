"""Shadows: a new map is written beside the one that readers use, then swapped in for it.

Creating the shadow, COPY, indexes, comparing numbers, the checkpoint and the swap are *one*
transaction per database. So an interruption of any kind at any moment leaves the old map in place
and nothing to clean up. After the commit only what was replaced is dropped and, for a large table,
the HNSW index built. A thread for each database writes while the fold goes on (`LoadingThread`).

Readers name the graph and AGE resolves each label's table by that name, so a statement must not
find half of its tables before the swap and half after. Therefore everything that is replaced, graph
and table, is locked exclusively *before* any name changes. The swap waits for a reader that already
has one of the tables; a later reader waits at its first table, and PostgreSQL resolves the name
again when it gets the lock.

While the swap waits and holds some of the locks, a reader may wait for it: a deadlock. So it waits
only briefly, releases all locks, and tries again; within the server's deadlock_timeout (1 s) it
always gives way before a reader is cancelled. The locks of two databases are taken and released
together: no server can detect a deadlock between them, and readers of one must not wait for those
of the other.
"""

import contextlib
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Final, Self, TypeAlias

import psycopg

from eventsrc.log import Event, event_hash
from projections.fold.map_errors import DatabaseError
from projections.map.changes import BatchChanges
from projections.map.digest import map_digest
from projections.map.view import MapView

from . import checkpoints
from .checkpoints import DeadLetter
from .connection import Connection, database_errors
from .inputs import MapInputs
from .live_fold import LiveFold
from .map_table import maps_key
from .sink import Checkpoint, Shadow
from .stores import DatabaseSink, Store
from .vector_sink import HnswReport, build_hnsw

Job: TypeAlias = Callable[[], None]

WAITING_JOBS: Final = 4
SWITCH_S: Final = 0.0005
"""Seconds that the fold may hold the interpreter while this thread waits for it. Python's own 5 ms
would add up, as a COPY asks for it with every 128 kB."""


class LoadingThread:
    """A thread that writes to the database while the fold goes on; use as a context manager.

    The fold keeps one core busy and PostgreSQL another; without a thread their times would add up.
    Jobs run one after the other on one connection, which nothing else may use before `flush`. At
    most `WAITING_JOBS` wait, so memory stays bounded: `put` blocks while there are more. An error
    inside drops the jobs that have not begun and calls ``cancel`` to interrupt the one that has. A
    daemon: where a second Ctrl-C ends the wait for that one, the program does not wait for it.
    """

    def __init__(self, cancel: Callable[[], None] = lambda: None) -> None:
        self._cancel = cancel
        self._jobs: queue.Queue[Job | None] = queue.Queue(WAITING_JOBS)
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="loading", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            if error is not None and self._failed is None:
                self._failed = error
                self._cancel()
        finally:
            self._jobs.put(None)
            self._thread.join()

    def put(self, job: Job) -> None:
        """Run ``job`` in the thread. Raises what an earlier one raised."""
        self._raise()
        self._jobs.put(job)

    def flush(self) -> None:
        """Wait until all jobs are done. Raises what one raised."""
        self._jobs.join()
        self._raise()

    def _raise(self) -> None:
        if self._failed is not None:
            raise self._failed

    def _work(self) -> None:
        while (job := self._jobs.get()) is not None:
            try:
                if self._failed is None:
                    job()
            except BaseException as error:  # noqa: BLE001 - raised by `put` and `flush`
                self._failed = self._failed or error
            finally:
                self._jobs.task_done()


@contextmanager
def short_turns() -> Iterator[None]:
    """Have threads switch every `SWITCH_S` instead of Python's default."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)


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


ShadowOf: TypeAlias = Callable[[DatabaseSink], Shadow[Connection]]
STREAM_ROWS: Final = 6_000
"""Keyframes and observations that wait before they are written: few enough that the server has
something to do from early on, enough for few COPYs, as the server makes up to 1,000 slots for the
rows of each (a tenth of its time, with 2,000)."""


def stream(fold: LiveFold, writers: Sequence[ShadowWriter]) -> None:
    """Write the fold's new rows if enough of them wait."""
    if fold.tracker.added >= STREAM_ROWS:
        changes = fold.tracker.drain()
        for writer in writers:
            writer.load(changes, fold.view)


@contextlib.contextmanager
def _shadow_writers(stores: Sequence[Store], shadow_of: ShadowOf) -> Iterator[list[ShadowWriter]]:
    """A thread for each store, which begins with creating the shadows."""
    with contextlib.ExitStack() as threads:
        writers = []
        for store in stores:
            thread = threads.enter_context(LoadingThread(partial(_cancel, store.connection)))
            shadows = [shadow_of(sink) for sink in store.sinks]
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
"""Timeouts of one attempt to lock. A sink's tables are locked by one statement, which may wait for
several readers in turn: both sinks together stay below a second."""
NO_TIMEOUTS: Final = "SET LOCAL lock_timeout = 0; SET LOCAL statement_timeout = 0"
PAUSE_S: Final = 0.02
LOCK_TIMEOUT_S: Final = 120.0
"""Seconds to try to lock the replaced tables."""


def lock_readers(writers: Sequence[ShadowWriter]) -> None:
    """Lock the tables that the shadows will replace. Raises DatabaseError after
    `LOCK_TIMEOUT_S`."""
    deadline = time.monotonic() + LOCK_TIMEOUT_S
    while (store := _store_with_readers(writers)) is not None:
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"{store.place}: readers kept the map locked for {LOCK_TIMEOUT_S:.0f} s; end their"
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
    """Try once: None when all tables are locked; else none is, and readers hold locks in the
    returned store."""
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


@dataclass(frozen=True, slots=True)
class FoldedLog:
    """A fold of a log, made with ``inputs``: its last event, and the events that were left out."""

    fold: LiveFold
    last: Event | None
    inputs: MapInputs
    letters: tuple[DeadLetter, ...] = ()


@dataclass(frozen=True, slots=True)
class Swap:
    """The map that was swapped in: its digest, and rows by label and table."""

    digest: str
    rows: dict[str, int]


Notify: TypeAlias = Callable[[str], None]
"""A function called with each stage as it begins: writing, swapping, tidying, indexing."""
FoldInto: TypeAlias = Callable[[Sequence[ShadowWriter]], FoldedLog]
"""A function that folds a log and, with `stream`, writes rows to the shadows during the fold."""


def swap_in_new_map(
    stores: Sequence[Store],
    log_id: str,
    fold_into: FoldInto,
    notify: Notify,
    *,
    shadow_of: ShadowOf = lambda sink: sink.shadow(),
) -> Swap:
    """Replace the map that readers see. On any exception the old map stays."""
    with _transactions(stores):
        with short_turns(), _shadow_writers(stores, shadow_of) as writers:
            folded = fold_into(writers)
            notify("writing")
            fold = folded.fold
            changes = fold.tracker.drain()
            for writer in writers:
                writer.load(changes, fold.view)
                writer.finish(fold.view)
            digest = map_digest(fold.view)
            for writer in writers:
                writer.thread.flush()
        notify("swapping")
        lock_readers(writers)
        checkpoint = folded.inputs.checkpoint(
            log_id, fold.map.next_offset, event_hash(folded.last), digest, maps_key(fold.view)
        )
        for writer in writers:
            writer.store.run(
                partial(_replace_checkpoints, writer.store, checkpoint, folded.letters)
            )
            for shadow in writer.shadows:
                writer.store.run(shadow.swap_in)
    return Swap(digest, {label: n for writer in writers for label, n in writer.rows.items()})


@contextlib.contextmanager
def _transactions(stores: Sequence[Store]) -> Iterator[None]:
    """A transaction in each store, committed in turn; an error inside rolls all of them back."""
    with contextlib.ExitStack() as transactions:
        for store in stores:
            transactions.enter_context(database_errors(store.url))
            transactions.enter_context(store.connection.transaction())
        yield


def _replace_checkpoints(
    store: Store, checkpoint: Checkpoint, letters: Sequence[DeadLetter], connection: Connection
) -> None:
    for sink in store.sinks:
        checkpoints.replace(connection, sink.name, checkpoint)
        for letter in letters:
            checkpoints.park(connection, sink.name, letter)


@contextlib.contextmanager
def _errors_after_swap() -> Iterator[None]:
    """Add to a DatabaseError that the new map is in place."""
    try:
        yield
    except DatabaseError as error:
        raise type(error)(f"{error}; the new map is in place nevertheless") from error


def drop_replaced(stores: Sequence[Store], notify: Notify, *, hnsw: bool) -> HnswReport | None:
    """After the commit: drop the replaced tables; with ``hnsw`` build that index if it pays."""
    notify("tidying")
    with _errors_after_swap():
        return _drop_replaced(stores, notify, hnsw=hnsw)


def _drop_replaced(stores: Sequence[Store], notify: Notify, *, hnsw: bool) -> HnswReport | None:
    index: HnswReport | None = None
    for store in stores:
        for sink in store.sinks:
            with store.throwaway_connection() as connection:
                sink.drop_replaced(connection)
        if hnsw and any(sink.name == "vectors" for sink in store.sinks):
            notify("indexing")
            with store.throwaway_connection() as connection:
                index = build_hnsw(connection)
    return index
