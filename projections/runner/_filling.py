"""Filling the shadows of a rebuild: a thread for each database, and what it is given to do."""

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import psycopg

from projections.postgres.connect import Connection
from projections.sink import Sink

from ._loading import Loading
from ._stores import Store


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
