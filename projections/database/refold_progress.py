"""A refold's progress where other processes can read it: in the checkpoints, as heartbeats are.

The refold's own connections are in the transaction of the swap, and what they write is not seen
before its end. So a thread writes over connections of its own, also while the others wait.
"""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from types import TracebackType
from typing import Final, Self

from . import checkpoints
from .connection import Connection, database_errors
from .stores import Store

BEAT_S: Final = 1.0


class RefoldProgress:
    """A context manager around a refold of ``stores``. ``tell`` raises what the thread raised."""

    def __init__(self, stores: Sequence[Store]) -> None:
        self._stores = stores
        self._at: tuple[int, int] | tuple[None, None] = (0, 0)
        self._held = threading.Lock()
        self._ended = threading.Event()
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="refold-progress", daemon=True)
        self._stack = contextlib.ExitStack()
        self._connections: list[tuple[Store, Connection]] = []

    def __enter__(self) -> Self:
        with contextlib.ExitStack() as stack:
            for store in self._stores:
                connection = stack.enter_context(store.throwaway_connection())
                self._connections.append((store, connection))
            self._write()
            self._stack = stack.pop_all()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        self._stack.close()

    def tell(self, done: int, total: int) -> None:
        """``done`` of ``total`` events are folded. Raises what the thread raised."""
        self._at = (done, total)
        if self._failed is not None:
            raise self._failed

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Write nothing for the length of the block, which changes the checkpoints; afterwards the
        refold is over."""
        with self._held:
            yield
            self._at = (None, None)

    def _work(self) -> None:
        try:
            while not self._ended.wait(BEAT_S):
                with self._held:
                    self._write()
        except BaseException as error:  # noqa: BLE001 - raised by `tell`
            self._failed = error

    def _write(self) -> None:
        for store, connection in self._connections:
            with database_errors(store.url):
                for sink in store.sinks:
                    checkpoints.write_refold(connection, sink.name, *self._at)
