"""A thread that writes to the database while the fold goes on.

The fold keeps one core busy and PostgreSQL another; without a thread their times would add up. Jobs
run one after the other on one connection, which nothing else may use before `flush`. At most
`WAITING_JOBS` wait, so memory stays bounded: `put` blocks while there are more.
"""

import queue
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Final, Self, TypeAlias

Job: TypeAlias = Callable[[], None]

WAITING_JOBS: Final = 4
SWITCH_S: Final = 0.0005
"""Seconds that the fold may hold the interpreter while this thread waits for it. Python's own 5 ms
would add up, as a COPY asks for it with every 128 kB."""


class LoadingThread:
    """Use as a context manager; leaving it ends the thread.

    An error inside drops the jobs that have not begun and calls ``cancel`` to interrupt the one
    that has.
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
