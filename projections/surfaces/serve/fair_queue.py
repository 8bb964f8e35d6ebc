"""A bounded queue of questions that is fair to peers, and the threads that answer them.

* Round robin: one question of each peer in turn. So a peer that sends thousands of questions delays
  its own and not those of others.
* When the queue is full, the peer with the most questions in it loses its newest.
* A question that has waited for ``max_wait_s`` is refused instead of answered too late.

Refusals are sent by a thread of their own, because sending one may take long.
"""

import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Final, Self, TypeVar

from .answering import BusyError

Result = TypeVar("Result")

CAPACITY: Final = 64
MAX_WAIT_S: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    work: Callable[[], Any]
    future: "Future[Any]"
    submitted_s: float

    def run(self) -> None:
        if not self.future.set_running_or_notify_cancel():
            return
        try:
            result = self.work()
        except BaseException as error:  # noqa: BLE001  passed on by the future
            self.future.set_exception(error)
        else:
            self.future.set_result(result)

    def refuse(self) -> None:
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(
                BusyError(
                    "too many questions are waiting, or the service is stopping; ask again later"
                )
            )


class FairQueue:
    """Runs submitted work on ``workers`` threads. Close it, or use it in a ``with`` block."""

    def __init__(
        self, workers: int, *, capacity: int = CAPACITY, max_wait_s: float = MAX_WAIT_S
    ) -> None:
        self.capacity, self._max_wait_s = capacity, max_wait_s
        self._queued: dict[str, deque[_Job]] = {}  # by peer, in the order of their turns
        self._refused: list[_Job] = []
        self._closing = False
        self._changed = threading.Condition()
        self._threads = [threading.Thread(target=self._refuse, name="refuse")] + [
            threading.Thread(target=self._answer, name=f"answer-{n}") for n in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, peer: str, work: Callable[[], Result]) -> "Future[Result]":
        """Queue ``work`` for a turn of ``peer``. The future may raise BusyError."""
        job = _Job(work, Future(), time.monotonic())
        with self._changed:
            if self._closing:
                job.refuse()
                return job.future
            self._queued.setdefault(peer, deque()).append(job)
            if sum(map(len, self._queued.values())) > self.capacity:
                heaviest = max(self._queued, key=lambda name: len(self._queued[name]))
                self._refused.append(self._queued[heaviest].pop())
                self._drop_empty()
            self._changed.notify_all()
        return job.future

    def __len__(self) -> int:
        """The number of waiting questions."""
        with self._changed:
            return sum(map(len, self._queued.values()))

    def close(self) -> None:
        """Refuse new work and finish what is queued. May be called twice."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _answer(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queued or self._closing)
                job = self._next()
            if job is not None:
                job.run()
            elif self._closing:
                return

    def _refuse(self) -> None:
        while True:
            with self._changed:
                self._expire()
                refused, self._refused = self._refused, []
                if not refused:
                    if self._closing:
                        return
                    self._changed.wait(self._until_next_expires())
            for job in refused:
                job.refuse()

    def _next(self) -> _Job | None:
        for peer in self._queued:
            jobs = self._queued.pop(peer)
            job = jobs.popleft()
            if jobs:
                self._queued[peer] = jobs  # after all other peers
            return job
        return None

    def _expire(self) -> None:
        oldest = time.monotonic() - self._max_wait_s
        for jobs in () if self._closing else self._queued.values():
            while jobs and jobs[0].submitted_s <= oldest:
                self._refused.append(jobs.popleft())
        self._drop_empty()

    def _until_next_expires(self) -> float | None:
        first = min((jobs[0].submitted_s for jobs in self._queued.values()), default=None)
        return None if first is None else max(0.0, first + self._max_wait_s - time.monotonic())

    def _drop_empty(self) -> None:
        self._queued = {peer: jobs for peer, jobs in self._queued.items() if jobs}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
