"""The interface of engines, which run a task for each site, and their results."""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol, Self, TypeAlias

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
