"""Engines run a task for each site; this one, `LocalPool`, in worker processes on this machine.

Each worker is a pool of one process (`concurrent.futures`). When one is killed, only its pool
breaks, which identifies the interrupted site; the site is started again in a new process, at most
`RETRIES` times, and the others go on.

Workers end with the process that started them, even if that is killed: they wait on a pipe whose
only writing end is here. They ignore Ctrl-C of the terminal; this process ends them.
"""

import contextlib
import gc
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection
from typing import Any, Final, Protocol, Self, TypeAlias

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import counted

RETRIES: Final = 2
"""The most times that the task of a killed worker is started again."""

Progress: TypeAlias = Callable[[int], None]
"""A function that receives the number of events that a task has processed."""
Task: TypeAlias = Callable[[Any, Progress], Any]
"""A task is a module-level function, which workers import; request and result are pickled. Errors
of the site's log or database are in the result, not raised."""


@dataclass(frozen=True, slots=True)
class Ended:
    """The outcome of the request with this index: a result, or ``error`` when its workers were
    killed `RETRIES` + 1 times or the task raised. ``attempts`` counts its starts, as far as the
    engine can count them."""

    index: int
    result: Any
    error: str | None
    attempts: int


class Engine(Protocol):
    """Runs tasks. A context manager; leaving it ends or cancels what still runs."""

    def run(
        self, task: Task, requests: Sequence[Any], progress: Progress | None = None
    ) -> Iterator[Ended]:
        """Run the task for each request; yields each as soon as it has ended. ``progress`` receives
        the sum of the events that tasks have reported, several times a second."""

    def __enter__(self) -> Self: ...

    def __exit__(self, kind: object, error: object, at: object, /) -> None: ...


def usable_cores() -> int:
    """The cores this process may run on, which may be fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


_POLL_S: Final = 0.25
_ERROR_CHARS: Final = 400
"""Longest text kept of an unexpected error."""


class WorkersError(MapfoldError):
    """Worker processes cannot be started."""


class LocalPool:
    """``jobs`` worker processes, started when there is work for them."""

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        resource_tracker.ensure_running()  # its start would unblock SIGINT in `_submit`
        self._context = get_context("spawn")
        self._alive_reader, self._alive_writer = self._context.Pipe(duplex=False)
        self._workers: list[ProcessPoolExecutor | None] = [None] * jobs
        self._done: Any = self._context.RawArray("q", 1)

    def run(
        self, task: Task, requests: Sequence[Any], progress: Progress | None = None
    ) -> Iterator[Ended]:
        """See `Engine.run`."""
        for slot in range(self._jobs):
            self._discard(slot)  # it has the counters of an earlier run
        self._done = self._context.RawArray("q", max(1, len(requests)))
        waiting = deque(range(len(requests)))
        attempts = [0] * len(requests)
        running: dict[Future[Any], tuple[int, int]] = {}
        free = set(range(self._jobs))
        while waiting or running:
            while waiting and free:
                slot, index = free.pop(), waiting.popleft()
                attempts[index] += 1
                running[self._submit(slot, task, requests[index], index)] = slot, index
            done, _ = wait(running, timeout=_POLL_S, return_when=FIRST_COMPLETED)
            for future in done:
                slot, index = running.pop(future)
                free.add(slot)
                error = future.exception()
                if isinstance(error, BrokenProcessPool):
                    self._discard(slot)
                    if attempts[index] <= RETRIES:
                        self._done[index] = 0
                        waiting.appendleft(index)
                        continue
                yield Ended(
                    index,
                    None if error is not None else future.result(),
                    None if error is None else _error_text(error, attempts[index]),
                    attempts[index],
                )
            if progress is not None:
                progress(sum(self._done))

    def _submit(self, slot: int, task: Task, request: Any, index: int) -> Future[Any]:
        # Both the process that `submit` starts and this one have SIGINT blocked meanwhile; here it
        # is delivered after that, there never.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            while True:
                worker = self._workers[slot]
                if worker is None:
                    worker = self._workers[slot] = ProcessPoolExecutor(
                        1, self._context, _prepare, (self._alive_reader, self._done)
                    )
                with contextlib.suppress(BrokenProcessPool):  # killed while it had nothing to do
                    return worker.submit(_call, task, request, index)
                self._discard(slot)
        except OSError as error:
            raise WorkersError(
                f"--jobs {self._jobs}: no more worker processes can be started: {error.strerror};"
                " run with fewer --jobs"
            ) from error
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)

    def _discard(self, slot: int) -> None:
        worker, self._workers[slot] = self._workers[slot], None
        if worker is not None:
            worker.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the workers at once, also running ones."""
        self._alive_writer.close()
        for slot in range(self._jobs):
            self._discard(slot)
        self._alive_reader.close()


_done: Any = None
"""In a worker: the number of processed events by request."""


def _prepare(alive: Connection, done: Any) -> None:
    global _done
    _done = done
    threading.Thread(target=_end_with_parent, args=(alive,), name="parent", daemon=True).start()
    gc.freeze()


def _end_with_parent(alive: Connection) -> None:
    with contextlib.suppress(EOFError, OSError):
        alive.recv_bytes()
    os._exit(1)  # a session of the database that ends in the middle is rolled back


def _call(task: Task, request: Any, index: int) -> Any:
    def report(events: int) -> None:
        _done[index] = events

    return task(request, report)


def _error_text(error: BaseException, attempts: int) -> str:
    if isinstance(error, BrokenProcessPool):
        return (
            f"its worker process was killed {counted(attempts, 'time')}; out of memory? Look"
            " in the kernel's log, or run with fewer --jobs"
        )
    return f"a fault in mapfold: {type(error).__name__}: {str(error)[:_ERROR_CHARS]}"
