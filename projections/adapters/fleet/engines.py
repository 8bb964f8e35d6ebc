"""Engines run a task for each site: `LocalPool` in worker processes on this machine, `DaskCluster`
on an existing Dask cluster (``--engine dask://HOST:PORT``).

The only importer of ``distributed``. There each site is one task. When a worker is killed the
scheduler gives its tasks to others; a task whose workers were killed is submitted again `RETRIES`
times.
"""

import logging
import queue
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Protocol, Self, TypeAlias
from uuid import uuid4

from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.text import counted
from eventsrc.base.worker_process import Called, ProcessGone, ProcessKilled, call_in_processes

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


_ERROR_CHARS: Final = 400
"""Longest text kept of an unexpected error."""


class WorkersError(MapfoldError):
    """Worker processes cannot be started."""


class LocalPool:
    """``jobs`` worker processes, started when there is work for them.

    When one is killed, its site is started again in a new process, at most `RETRIES` times, and the
    others go on. Workers end with the process that started them, even if that is killed.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._running: list[Generator[Ended]] = []

    def run(
        self, task: Task, requests: Sequence[Any], progress: Progress | None = None
    ) -> Iterator[Ended]:
        """See `Engine.run`."""
        running = self._run([partial(task, request) for request in requests], progress)
        self._running.append(running)
        return running

    def _run(
        self, calls: Sequence[Callable[[Progress], Any]], progress: Progress | None
    ) -> Generator[Ended]:
        try:
            for each in call_in_processes(calls, self._jobs, progress, attempts=RETRIES + 1):
                yield Ended(each.number, each.result, _error_text(each), each.attempts)
        except ProcessGone as error:
            raise WorkersError(
                f"--jobs {self._jobs}: no more worker processes can be started: {error}; run with"
                " fewer --jobs"
            ) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the workers at once, also running ones."""
        for running in self._running:
            running.close()


def _error_text(ended: Called[Any]) -> str | None:
    if isinstance(ended.error, ProcessKilled):
        return (
            f"its worker process was killed {counted(ended.attempts, 'time')}; out of memory? Look"
            " in the kernel's log, or run with fewer --jobs"
        )
    if isinstance(ended.error, ProcessGone):
        return f"its worker process died {counted(ended.attempts, 'time')}: {ended.error}"
    if ended.error is None:
        return None
    text = str(ended.error)[:_ERROR_CHARS]
    return f"a fault in mapfold: {type(ended.error).__name__}: {text}"


_CONNECT_S: Final = 10.0
_ANSWER_S: Final = 12.0
_POLL_S: Final = 0.25
_GONE_S: Final = 20.0
"""Longest time without a connection to the scheduler; it has no results meanwhile."""

_LOGGERS: Final = ("distributed", "distributed.client", "distributed.gc", "tornado.application")
"""Those that the import of ``distributed`` gives a level; a client's prints a traceback when it
stops looking for its scheduler."""


class ClusterError(MapfoldError):
    """The cluster cannot be used, or its scheduler has ended."""


class DaskCluster:
    """A client of the scheduler at ``address``, HOST:PORT. Raises MisuseError without the package
    ``distributed``, and ClusterError when no scheduler answers."""

    def __init__(self, address: str) -> None:
        try:
            import distributed
        except ModuleNotFoundError:
            raise MisuseError(
                "--engine dask:// needs the package distributed: pip install 'mapfold[cluster]'"
            ) from None
        for name in _LOGGERS:  # errors are raised
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self.address = address
        client: Any = distributed.Client
        try:
            with ThreadPoolExecutor(1) as thread:  # the caller's may run an event loop
                thread.submit(_check_scheduler, f"tcp://{address}").result()
            self._client: Any = client(
                f"tcp://{address}", timeout=_CONNECT_S, set_as_default=False, name="mapfold"
            )
        except Exception as error:  # noqa: BLE001 - Dask's decoders fail in many ways
            raise ClusterError(
                f"--engine dask://{address}: no scheduler answers there: {_reason(error)}; start"
                " one with `dask scheduler` (port 8786; 8787 is its dashboard), and workers with"
                " `dask worker tcp://HOST:PORT --nthreads 1`"
            ) from None

    def wait_for_workers(self, number: int, seconds: float) -> None:
        """Wait until the cluster has so many workers. Raises ClusterError."""
        try:
            self._client.wait_for_workers(number, timeout=seconds)
        except TimeoutError:
            raise ClusterError(
                f"--engine dask://{self.address}: fewer than {counted(number, 'worker')}"
            ) from None

    def run(
        self, task: Task, requests: Sequence[Any], progress: Progress | None = None
    ) -> Iterator[Ended]:
        """See `Engine.run`; ``progress`` always receives 0."""
        ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        name = f"mapfold-{uuid4().hex[:8]}"
        futures: dict[str, tuple[int, Any]] = {}
        attempts = [0] * len(requests)

        def submit(index: int) -> None:
            attempts[index] += 1
            key = f"{name}-{index}-{attempts[index]}"
            future = self._client.submit(
                _call, task, requests[index], key=key, pure=False, retries=RETRIES
            )
            futures[key] = index, future
            future.add_done_callback(ended.put)

        for number in range(len(requests)):
            submit(number)
        away_since: float | None = None
        while futures:
            try:
                future = ended.get(timeout=_POLL_S)
            except queue.Empty:
                away_since = self._watch(away_since, len(futures), len(requests))
                if progress is not None:
                    progress(0)
                continue
            index, _ = futures.pop(future.key)
            if future.status in ("cancelled", "lost"):
                self._raise_gone(len(futures) + 1, len(requests))
            error = future.exception() if future.status == "error" else None
            if _was_killed(error) and attempts[index] <= RETRIES:
                submit(index)  # Dask also blames tasks that a killed worker had not started
                continue
            result = None if error is not None else future.result()
            yield Ended(
                index, result, None if error is None else _fault_text(error), attempts[index]
            )

    def _watch(self, away_since: float | None, left: int, total: int) -> float | None:
        """The time since which the scheduler is away; raises ClusterError when that is too long."""
        if self._client.status == "running":
            return None
        away_since = time.monotonic() if away_since is None else away_since
        if self._client.status == "closed" or time.monotonic() - away_since > _GONE_S:
            self._raise_gone(left, total)
        return away_since

    def _raise_gone(self, left: int, total: int) -> None:
        raise ClusterError(
            f"--engine dask://{self.address}: the scheduler has ended; of {left:,} of"
            f" {counted(total, 'site')} it is not known whether they are done. Run the command"
            " again: it skips those that are"
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        """Cancel tasks that have not started; running ones finish on their workers."""
        self._client.close(timeout=2.0 if kind is None else 0.5)


def _check_scheduler(address: str) -> None:
    """Raise an error unless the server at ``address`` says that it is a scheduler.

    A `Client` that meets another server, such as the dashboard, can wait without end, and cannot be
    closed.
    """
    import asyncio  # here: it takes long to import, also for workers

    kind = asyncio.run(_kind_of_server(address))  # noqa: TID251  in a thread of its own
    if kind != "Scheduler":
        raise ValueError(f"it is a Dask {kind}")


async def _kind_of_server(address: str) -> str:
    import asyncio

    import distributed.core

    connect: Any = distributed.core.rpc
    async with asyncio.timeout(_ANSWER_S):
        server = connect(address, timeout=_CONNECT_S)
        try:
            return str((await server.identity())["type"])
        finally:
            await server.close_rpc()


def _reason(error: Exception) -> str:
    if type(error) is TimeoutError:
        return f"no answer within {_ANSWER_S:g} s"
    text = str(error).splitlines()[0] if str(error) else type(error).__name__
    if isinstance(error, OSError) or type(error) is ValueError:  # the address is wrong, or away
        return text
    return f"the answer is not Dask's ({text[:100]})"


def _call(task: Task, request: Any) -> Any:
    return task(request, _unreported)


def _unreported(_events: int) -> None:
    """Drop the progress of a task: a cluster's tasks report at their end only."""


def _was_killed(error: BaseException | None) -> bool:
    return type(error).__name__ == "KilledWorker"


def _fault_text(error: BaseException) -> str:
    if _was_killed(error):
        return (
            "the workers that had it were killed, one after the other; out of memory? Look in"
            " their logs"
        )
    return f"{type(error).__name__}: {str(error)[:400]}"
