"""Connection pools to the live databases, ready for searching.

A connection that the server has dropped is noticed when it is used: the question is asked once more
on a fresh one, so a restart of the database costs no answer.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Self, TypeVar

from psycopg_pool import ConnectionPool, PoolTimeout

from projections.errors import DatabaseUnavailable
from projections.postgres.connect import CONNECT_SECONDS, Connection, Targets, connect, place
from projections.queries.relocalize import fetch, prepare_graph, prepare_vectors
from projections.relocalize import Candidates, Crop

Result = TypeVar("Result")


class Pools:
    """One pool when graph and vectors share a database, else two. Use in a ``with`` block."""

    def __init__(self, targets: Targets, size: int) -> None:
        for url in (targets.graph_url, targets.vector_url):
            connect(url).close()  # a clear error at once, where a pool would try on in silence
        self._targets = targets
        self._vectors = _pool(targets.vector_url, size, self._prepare_vectors)
        self._graph = self._vectors
        if not targets.one_database:
            self._graph = _pool(targets.graph_url, size, prepare_graph)

    def _prepare_vectors(self, connection: Connection) -> None:
        prepare_vectors(connection)
        prepare_graph(connection)

    def candidates(self, crops: Sequence[Crop]) -> Candidates:
        """`projections.queries.relocalize.fetch` over pooled connections."""
        return self._twice(lambda: self._candidates(crops))

    def on_graph(self, ask: Callable[[Connection], Result]) -> Result:
        """Ask the graph's database something."""

        def once() -> Result:
            with self._borrow(self._graph, self._targets.graph_url) as connection:
                return ask(connection)

        return self._twice(once)

    def _candidates(self, crops: Sequence[Crop]) -> Candidates:
        with self._borrow(self._vectors, self._targets.vector_url) as vectors:
            if self._graph is self._vectors:
                return fetch(vectors, vectors, crops)
            with self._borrow(self._graph, self._targets.graph_url) as graph:
                return fetch(vectors, graph, crops)

    def _twice(self, ask: Callable[[], Result]) -> Result:
        try:
            return ask()
        except DatabaseUnavailable:
            for pool in {self._vectors, self._graph}:
                pool.check()
            return ask()

    @contextlib.contextmanager
    def _borrow(self, pool: "ConnectionPool[Connection]", url: str) -> Iterator[Connection]:
        try:
            with pool.connection(timeout=CONNECT_SECONDS) as connection:
                yield connection
        except PoolTimeout:
            raise DatabaseUnavailable(
                f"{place(url)}: no connection within {CONNECT_SECONDS} s; is the server running?"
            ) from None

    def close(self) -> None:
        """Close all connections. May be called twice."""
        for pool in {self._vectors, self._graph}:
            pool.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _pool(
    url: str, size: int, prepare: Callable[[Connection], None]
) -> "ConnectionPool[Connection]":
    return ConnectionPool(
        url,
        min_size=1,
        max_size=size,
        open=True,
        configure=prepare,
        kwargs={"autocommit": True, "application_name": "mapfold serve"},
    )
