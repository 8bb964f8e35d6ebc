"""Engines run a task for each site; this one, `LocalPool`, in worker processes on this machine."""

from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Protocol, Self, TypeAlias

from eventsrc.base.errors import MapfoldError
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
