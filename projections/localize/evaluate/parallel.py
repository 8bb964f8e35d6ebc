"""Call independent functions in several processes.

This process makes calls too, and each further one as many as it can. The functions are passed to
the processes as one pickle in memory, which only processes of this program read, and results come
back as pickles over the connection. Results come back in the order of the calls.

If a process dies, because it was killed or a call raised, its unanswered calls are made again, in
this process if no other is left. So an error of a call is raised here.
"""

import contextlib
import gc
import mmap
import pickle
import struct
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from multiprocessing.connection import Connection
from typing import Final, Generic, TypeVar

from eventsrc.base.progress import report_progress
from eventsrc.base.worker_process import ProcessGone, WorkerProcess, unnamed_memory
from eventsrc.log.seek import Note

T = TypeVar("T")

CALLS_PER_WORKER: Final = 100
"""Calls for each process that is started; fewer are done before it has started: a question takes
ten milliseconds, a start half a second."""
_AHEAD: Final = 8
"""Calls assigned to a process at a time, so that it need not wait for this one."""
_NUMBER: Final = struct.Struct("<q")


def call_all(
    calls: Sequence[Callable[[], T]],
    workers: int,
    stage: str,
    unit: str,
    note: Note | None = None,
) -> list[T]:
    """The results of all calls, made by this process and up to ``workers`` further ones.

    Reports the progress; ``note`` is called if a process has died. Raises an exception of a call;
    of several an arbitrary one.
    """
    results: dict[int, T] = {}
    waiting = deque(range(len(calls)))
    with ExitStack() as stack:
        processes = _start(calls, min(workers, len(calls) // CALLS_PER_WORKER), stack)
        alive = list(processes)
        try:
            while len(results) < len(calls):
                report_progress(stage, len(results), len(calls), unit)
                for process in tuple(alive):
                    try:
                        process.take_answers(results)
                        while waiting and len(process.given) < _AHEAD:
                            process.give(waiting.popleft())
                    except ProcessGone:
                        alive.remove(process)
                        waiting.extend(process.not_in(results))
                if waiting:
                    number = waiting.popleft()
                    results[number] = calls[number]()
                elif unanswered := max((p.not_in(results) for p in alive), key=len, default=()):
                    number = unanswered[-1]  # it has probably not begun with this one
                    results[number] = calls[number]()
        finally:
            report_progress(stage, max(len(calls), 1), max(len(calls), 1), unit)
    if note is not None and len(alive) < len(processes):
        note(
            f"{len(processes) - len(alive)} of the {len(processes)} processes that asked died,"
            " perhaps for lack of memory; what they had not answered was asked again"
        )
    return [results[number] for number in range(len(calls))]


class _SharingProcess(WorkerProcess, Generic[T]):
    """A process that makes a share of the calls; ``given`` are the numbers of the unanswered ones,
    in order."""

    def __init__(self, memory: int) -> None:
        super().__init__(_make_calls, memory=memory)
        self.given: deque[int] = deque()

    def give(self, number: int) -> None:
        """Assign a call. Raises ProcessGone."""
        self.given.append(number)
        self.send(_NUMBER.pack(number))

    def take_answers(self, results: dict[int, T]) -> None:
        """Add the results that it has sent, by the number of their call. Raises ProcessGone."""
        while self.given and self.has_answer():
            result = pickle.loads(self.receive())  # noqa: S301 (from a process that we started)
            results[self.given.popleft()] = result

    def not_in(self, results: dict[int, T]) -> list[int]:
        """The calls that it was given and that have no result yet."""
        return [number for number in self.given if number not in results]


def _start(
    calls: Sequence[Callable[[], T]], count: int, stack: ExitStack
) -> list[_SharingProcess[T]]:
    """Processes that can make the calls; as many as can be started."""
    found: list[_SharingProcess[T]] = []
    if count <= 0:
        return found
    pickled = pickle.dumps(calls, protocol=pickle.HIGHEST_PROTOCOL)
    with (
        contextlib.suppress(ProcessGone, OSError),  # without them, this process makes all calls
        unnamed_memory(len(pickled)) as memory,
    ):
        with mmap.mmap(memory, len(pickled)) as shared:
            shared[:] = pickled
        while len(found) < count:
            found.append(stack.enter_context(_SharingProcess[T](memory)))
    return found


def _make_calls(connection: Connection, memory: str) -> None:
    """Run in the process: make call after call, until the connection is closed."""
    gc.disable()
    with mmap.mmap(int(memory), 0, access=mmap.ACCESS_READ) as pickled:
        calls = pickle.loads(pickled)  # noqa: S301 (from the process that started this one)
    gc.freeze()
    gc.enable()
    while True:
        (number,) = _NUMBER.unpack(connection.recv_bytes())
        connection.send_bytes(pickle.dumps(calls[number](), protocol=pickle.HIGHEST_PROTOCOL))
