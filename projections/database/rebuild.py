"""Rebuild: the whole log into a shadow, and the shadow into the readers' view, or nothing at all.

Everything up to the swap happens in *one* transaction per database: creating the shadow, COPY,
indexes, the counts, the checkpoint, the swap. So an interruption at any moment, of any kind, leaves
the old map served and nothing to clean up. What comes after the commit only helps: dropping what
was replaced, statistics, the HNSW index of a large table.

Filling the shadows of a rebuild: a thread for each database, and what it is given to do.

Keeping readers out for the moment of the swap, without ever making one fail.

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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

import psycopg

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.errors import DatabaseError, FoldError
from projections.model.digest import map_digest
from projections.model.fold import no_cycle_search
from projections.settings import Settings

from . import checkpoints
from .connection import Connection, Targets, database_errors
from .foreign_embedding import ForeignEmbedding, first_foreign_embedding
from .loader import LoaderName
from .loading_thread import Loading, short_turns
from .origin import command_line
from .shared_fold import LiveFold, batches
from .sink import Checkpoint, Sink
from .stores import Only, Store, open_stores
from .vector_sink import HnswReport, build_hnsw


class SinkLoading(NamedTuple):
    """A sink, where it lives, and the thread that writes there."""

    loading: Loading
    sink: Sink[Any]
    store: Store

    def put(self, job: Callable[[Connection], None]) -> None:
        """Have ``job`` done with the store's connection, its errors told as the store's."""
        self.loading.put(partial(self.store.do, job))


@contextlib.contextmanager
def loadings_of(stores: list[Store]) -> Iterator[list[SinkLoading]]:
    """A thread for each store, which begins its shadows, and which sink writes through which."""
    with contextlib.ExitStack() as threads:
        loadings = []
        for store in stores:
            loading = threads.enter_context(Loading(partial(_break_off, store.connection)))
            loading.put(partial(_begin, store))
            loadings += [SinkLoading(loading, sink, store) for sink in store.sinks]
        yield loadings


def _break_off(connection: Connection) -> None:
    with contextlib.suppress(psycopg.Error):  # the server is gone, and what it was at with it
        connection.cancel_safe()


def _begin(store: Store) -> None:
    with store.aside() as connection:
        for sink in store.sinks:
            sink.clear(connection)
    for sink in store.sinks:
        store.do(sink.begin)


ATTEMPT: Final = "SET LOCAL lock_timeout = '200ms'; SET LOCAL statement_timeout = '400ms'"
"""A sink's tables are locked by one statement, which may wait for one reader after the other: both
sinks together stay below a second."""
DONE: Final = "SET LOCAL lock_timeout = 0; SET LOCAL statement_timeout = 0"
PAUSE_S: Final = 0.02
PATIENCE_S: Final = 120.0


def lock_readers_out(stores: Sequence[Store]) -> None:
    """Lock what the stores' sinks will swap. Raises DatabaseError when readers never let go."""
    deadline = time.monotonic() + PATIENCE_S
    while (read := _still_read(stores)) is not None:
        if time.monotonic() > deadline:
            raise DatabaseError(
                f"{read.place}: readers kept the map locked for {PATIENCE_S:.0f} s; end their"
                " transactions, then run the rebuild again"
            )
        time.sleep(PAUSE_S)
    for store in stores:
        store.connection.execute(DONE)


class _StillRead(Exception):
    """A reader has one of the tables."""

    def __init__(self, store: Store) -> None:
        self.store = store


def _still_read(stores: Sequence[Store]) -> Store | None:
    """Try once: None when all is locked, else whose readers are in the way; then nothing is."""
    try:
        with contextlib.ExitStack() as savepoints:  # going back to them lets go of the locks
            for store in stores:
                with database_errors(store.url):
                    savepoints.enter_context(store.connection.transaction())
                    _lock(store)
    except _StillRead as reader:
        return reader.store
    return None


def _lock(store: Store) -> None:
    try:
        store.connection.execute(ATTEMPT)
        for sink in store.sinks:
            sink.lock(store.connection)
    except (psycopg.errors.LockNotAvailable, psycopg.errors.QueryCanceled):
        raise _StillRead(store) from None


TICK_EVENTS: Final = 256
"""Events between two looks at whether rows wait to be written and somebody wants to hear of it."""


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
            with short_turns(), loadings_of(stores) as loadings:
                events, advice = reader.read(FIRST_OFFSET, total), partial(_advice, log, settings)
                last = _fold_into(fold, events, loadings, total, tell, advice)
                folded = time.monotonic()
                tell(RebuildProgress("writing", total, total))
                for loading in loadings:
                    loading.put(loading.sink.load(loading.sink.take_rest(fold.view)))
                    loading.put(loading.sink.index)
                digest = map_digest(fold.view)
                for loading in loadings:
                    loading.loading.flush()
            checkpoint = Checkpoint(
                reader.log_id,
                settings.fingerprint(),
                settings.model_dump_json(),
                total,
                checkpoints.event_hash(last),
                digest,
            )
            rows = _check(stores, fold, checkpoint)
            tell(RebuildProgress("swapping", total, total))
            lock_readers_out(stores)
            for store in stores:
                for sink in store.sinks:
                    store.do(sink.swap)
        tell(RebuildProgress("tidying", total, total))
        with _swapped():
            index = _after(stores, tell, total, hnsw=hnsw)
        ended = time.monotonic()
        return RebuildReport(
            total,
            digest,
            fold.view.counts(),
            rows,
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
    loadings: list[SinkLoading],
    total: int,
    tell: OnProgress,
    advice: Callable[[int], str],
) -> Event | None:
    told_of = [each.sink for each in loadings if not each.sink.rebuilds_from_view]
    last: Event | None = None
    for batch in batches(events, TICK_EVENTS):
        for failed in fold.feed(batch, lambda _: told_of):
            if failed is not None:
                raise FoldError(failed.offset, f"{failed.reason}; {advice(failed.offset)}")
        last = batch[-1]
        tell(RebuildProgress("folding", last.offset + 1, total))
        for loading in loadings:
            rows = loading.sink.take_final(fold.view)
            if rows is not None:
                loading.put(loading.sink.load(rows))
    return last


def _advice(log: Path, settings: Settings, offset: Offset) -> str:
    """What to do about an event that cannot be folded."""
    before = command_line("replay", log, settings, "--until", str(offset))
    return (
        "the databases stay as they were; to leave it out run:"
        f" {before} && {command_line('tail', log, settings)}"
    )


def _check(stores: list[Store], fold: LiveFold, checkpoint: Checkpoint) -> dict[str, int]:
    """Compare, and put the checkpoints down; how many rows there are, by label and table."""
    rows: dict[str, int] = {}
    for store in stores:
        for sink in store.sinks:
            with database_errors(store.url):
                rows.update(sink.check(store.connection, fold.view))
                checkpoints.replace(store.connection, sink.name, checkpoint)
    return rows


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
            with store.aside() as connection:
                sink.tidy(connection)
        if hnsw and any(sink.name == "vectors" for sink in store.sinks):
            tell(RebuildProgress("indexing", total, total))
            with store.aside() as connection:
                index = build_hnsw(connection)
    return index
