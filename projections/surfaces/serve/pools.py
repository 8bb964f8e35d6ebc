"""Connection pools to the live databases, which survive a restart of the server.

A lost connection is noticed when it is used. Then the server is restarted if it is the embedded
one, else waited for, and the question is repeated on a new connection; so a restart of the
database costs no answer. After ``OUTAGE_TIMEOUT_S`` of an outage questions fail at once.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Self, TypeVar

from psycopg_pool import ConnectionPool, PoolTimeout

from eventsrc.base.text import advised
from projections.ask.words import ObjectVectors
from projections.fold.map_errors import DatabaseUnavailable, ProjectionMissing
from projections.localize.relocalize import MapCandidates, QuestionCrop
from projections.postgres import checkpoints
from projections.postgres.connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_target,
)
from projections.postgres.labels import SinkName
from projections.postgres.queries import candidate_search
from projections.postgres.queries.candidate_rows import ConstantsMemory
from projections.postgres.queries.live_view import LiveView, read_object_vectors, read_view

from .asked import MapMemory

OUTAGE_TIMEOUT_S: Final = 10.0
"""Questions in the first seconds of an outage wait for its end, later ones fail at once."""


class Outage:
    """An outage begins with the first failure and ends with the first success; ``note`` gets one
    line at each. For many threads."""

    def __init__(self, note: Callable[[str], None], now: Callable[[], float] = time.monotonic):
        self._note, self._now, self._lock = note, now, threading.Lock()
        self._until: float | None = None

    @property
    def is_on(self) -> bool:
        """Whether the last attempt failed."""
        return self._until is not None

    def begin(self, error: Exception) -> None:
        """Begin an outage, if none is under way; called after a failed attempt."""
        with self._lock:
            if self._until is None:
                self._until = self._now() + OUTAGE_TIMEOUT_S
                self._note(f"{error}; trying again")

    def end(self) -> None:
        """End an outage, if one is under way; called after a successful attempt."""
        with self._lock:
            if self._until is not None:
                self._until = None
                self._note("the database answers again")

    @property
    def worth_waiting(self) -> bool:
        """Whether the outage is so new that a question waits for its end."""
        until = self._until
        return until is not None and self._now() < until


Result = TypeVar("Result")

FIRST_WAIT_S: Final = 9.0
LAST_WAIT_S: Final = 1.0
RETRY_S: Final = 0.1
GIVE_UP_S: Final = 0.5
"""By default a pool retries with ever longer pauses, up to minutes; so it gives up soon, and the
next question makes it try again."""


class _NoneFreeError(DatabaseUnavailable):
    """Every connection of the pool was in use for too long."""


class Pools:
    """One pool when graph and vectors share a database, else two. Use in a ``with`` block.

    ``note`` gets a line when a database goes away and one when it is back.
    """

    def __init__(
        self, targets: Targets, size: int, note: Callable[[str], None] = lambda _: None
    ) -> None:
        self._targets, self._size, self._outage = targets, size, Outage(note)
        self._memory, self._map = ConstantsMemory(), MapMemory()
        self._require_maps()  # a clear error at once; a pool would retry without one
        candidate_search.CandidateReader(targets).close()
        self._vectors = _pool(targets.vector_url, size, self._prepare_vectors)
        self._graph = self._vectors
        if not targets.one_database:
            self._graph = _pool(targets.graph_url, size, candidate_search.prepare_graph)

    def _prepare_vectors(self, connection: Connection) -> None:
        candidate_search.prepare_vectors(connection)
        candidate_search.prepare_graph(connection)

    def check(self) -> None:
        """Restart the embedded server if it died. Raises DatabaseError unless there is a map that
        answers a question.

        Uses new connections, so that it sees the present state.
        """
        self._require_maps()
        with candidate_search.CandidateReader(self._targets, self._memory) as reader:
            reader.try_question()

    def _require_maps(self) -> None:
        self._targets.restart_embedded()
        _require_map("graph", self._targets.graph_url)
        _require_map("vectors", self._targets.vector_url)

    def candidates(self, crops: Sequence[QuestionCrop]) -> MapCandidates:
        """`CandidateSearch.candidates` over pooled connections."""
        return self._ask(lambda wait_s: self._candidates(crops, wait_s))

    def on_graph(self, ask: Callable[[Connection], Result]) -> Result:
        """``ask`` on a pooled connection to the graph's database."""

        def once(wait_s: float) -> Result:
            with self._borrow(self._graph, self._targets.graph_url, wait_s) as connection:
                return ask(connection)

        return self._ask(once)

    def view(self) -> LiveView:
        """The map of the graph's database, not to be changed."""
        return self.on_graph(
            lambda graph: self._map.view(checkpoints.load(graph, "graph"), lambda: read_view(graph))
        )

    def object_vectors(self) -> ObjectVectors:
        """The mean vectors of the map's Objects."""

        def once(wait_s: float) -> ObjectVectors:
            with self._borrow(self._vectors, self._targets.vector_url, wait_s) as vectors:
                if self._graph is self._vectors:
                    return read_object_vectors(vectors, vectors)
                with self._borrow(self._graph, self._targets.graph_url, wait_s) as graph:
                    return read_object_vectors(graph, vectors)

        return self._ask(once)

    def _candidates(self, crops: Sequence[QuestionCrop], wait_s: float) -> MapCandidates:
        with self._borrow(self._vectors, self._targets.vector_url, wait_s) as vectors:
            if self._graph is self._vectors:
                return self._search(vectors, vectors).candidates(crops)
            with self._borrow(self._graph, self._targets.graph_url, wait_s) as graph:
                return self._search(vectors, graph).candidates(crops)

    def _search(self, vectors: Connection, graph: Connection) -> candidate_search.CandidateSearch:
        return candidate_search.CandidateSearch(self._targets, vectors, graph, self._memory)

    def _ask(self, ask: Callable[[float], Result]) -> Result:
        if self._outage.is_on:
            self._recover()
        try:
            return ask(FIRST_WAIT_S)
        except _NoneFreeError:  # too many questions, or the server is away
            self._recover()
            return ask(LAST_WAIT_S)
        except DatabaseUnavailable as error:
            self._outage.begin(error)
            self._recover()
            return ask(FIRST_WAIT_S)

    def _recover(self) -> None:
        """Wait until the server is back; raise its error when it stays away."""
        while True:
            try:
                self._require_maps()
            except DatabaseUnavailable as error:
                self._outage.begin(error)
                if not self._outage.worth_waiting:
                    raise
                time.sleep(RETRY_S)
            else:
                break
        for pool in {self._vectors, self._graph}:
            pool.check()
        self._outage.end()

    @contextlib.contextmanager
    def _borrow(
        self, pool: "ConnectionPool[Connection]", url: str, wait_s: float
    ) -> Iterator[Connection]:
        try:
            with pool.connection(timeout=wait_s) as connection, database_errors(url):
                yield connection
        except PoolTimeout:
            raise _NoneFreeError(
                f"{describe_target(url)}: none of the {self._size} connections came free within"
                f" {FIRST_WAIT_S + LAST_WAIT_S:.0f} s; ask again later, or raise --workers"
            ) from None

    def close(self) -> None:
        """Close all connections. May be called twice."""
        for pool in {self._vectors, self._graph}:
            pool.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _require_map(sink: SinkName, url: str) -> None:
    """Raise DatabaseError unless the server answers and has a map."""
    with (
        connect(url, application="mapfold serve", autocommit=True) as connection,
        database_errors(url),
    ):
        if checkpoints.load(connection, sink) is None:
            raise ProjectionMissing(
                f"{describe_target(url)}: no {sink} there: nothing has been projected yet; run"
                f" `{advised('replay')}`"
            )


def _pool(
    url: str, size: int, prepare: Callable[[Connection], None]
) -> "ConnectionPool[Connection]":
    return ConnectionPool(
        url,
        min_size=1,
        max_size=size,
        open=True,
        configure=prepare,
        reconnect_timeout=GIVE_UP_S,
        kwargs={"autocommit": True, "application_name": "mapfold serve"},
    )
