"""The waiting room: a bounded queue of questions, fair to those who ask, and threads that answer.

* Peers take turns: one question of each, round robin. So a peer that sends thousands of questions
  delays its own and not those of others.
* When the room is full, the peer with the most questions in it loses its newest.
* A question that has waited for ``patience_s`` is refused instead of answered too late.

A thread of its own tells those that are refused, because it may take long to reach them.
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

WAITING: Final = 64
PATIENCE_S: Final = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    work: Callable[[], Any]
    future: "Future[Any]"
    come_s: float

    def run(self) -> None:
        if not self.future.set_running_or_notify_cancel():
            return
        try:
            result = self.work()
        except BaseException as error:  # noqa: BLE001  whoever holds the future handles it
            self.future.set_exception(error)
        else:
            self.future.set_result(result)

    def refuse(self) -> None:
        if self.future.set_running_or_notify_cancel():
            self.future.set_exception(
                BusyError("too many questions are waiting, or the service ends; ask again later")
            )


class Room:
    """Runs what is submitted on ``workers`` threads. Close it, or use it in a ``with`` block."""

    def __init__(
        self, workers: int, *, waiting: int = WAITING, patience_s: float = PATIENCE_S
    ) -> None:
        self._most, self._patience_s = waiting, patience_s
        self._turns: dict[str, deque[_Job]] = {}  # in the order in which the peers are served
        self._refused: list[_Job] = []
        self._closing = False
        self._changed = threading.Condition()
        self._threads = [threading.Thread(target=self._refuse, name="refuse")] + [
            threading.Thread(target=self._answer, name=f"answer-{n}") for n in range(workers)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, peer: str, work: Callable[[], Result]) -> "Future[Result]":
        """Have ``work`` done in the turn of ``peer``. The future may raise BusyError."""
        job = _Job(work, Future(), time.monotonic())
        with self._changed:
            if self._closing:
                job.refuse()
                return job.future
            self._turns.setdefault(peer, deque()).append(job)
            if sum(map(len, self._turns.values())) > self._most:
                heaviest = max(self._turns, key=lambda name: len(self._turns[name]))
                self._refused.append(self._turns[heaviest].pop())
                self._drop_empty()
            self._changed.notify_all()
        return job.future

    def close(self) -> None:
        """Take no more, do what was taken. May be called twice."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    def _answer(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._turns or self._closing)
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
        for peer in self._turns:
            jobs = self._turns.pop(peer)
            job = jobs.popleft()
            if jobs:
                self._turns[peer] = jobs  # behind all others
            return job
        return None

    def _expire(self) -> None:
        oldest = time.monotonic() - self._patience_s
        for jobs in () if self._closing else self._turns.values():
            while jobs and jobs[0].come_s <= oldest:
                self._refused.append(jobs.popleft())
        self._drop_empty()

    def _until_next_expires(self) -> float | None:
        first = min((jobs[0].come_s for jobs in self._turns.values()), default=None)
        return None if first is None else max(0.0, first + self._patience_s - time.monotonic())

    def _drop_empty(self) -> None:
        self._turns = {peer: jobs for peer, jobs in self._turns.items() if jobs}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
