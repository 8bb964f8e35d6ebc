"""Worker processes of this program, which get requests and send answers over a connection.

`WorkerProcess` runs one function, which reads requests; `call_in_processes` makes independent calls
in several processes. A worker may be killed at any moment: the process that started it then does
the work itself, or again. A worker exits when its connection is closed, which happens when the
process that started it dies. It is in a process group of its own, so Ctrl-C in a terminal reaches
that process only, which ends its workers.

Not `multiprocessing`: its processes import the caller's main module again (the whole command line,
or a script that has no ``if __name__ == "__main__"``), and it starts another process to remove
named shared memory, which is in ``/dev/shm``, and stays there when both are killed. This memory has
no name: it is freed with the processes that use it, and not bounded by ``/dev/shm``.
"""

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Self, TypeAlias, TypeVar

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

T = TypeVar("T")

Report: TypeAlias = Callable[[int], None]
"""Receives how much of the work is done, in a unit of the caller's."""
Call: TypeAlias = Callable[[Report], T]
"""A function of a module, or a `functools.partial` of one; pickled, as its result is."""

_PROGRAM: Final = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
    "from eventsrc.base.worker_process import _work; _work(*sys.argv[1:])"
)
_REPORT_S: Final = 0.1
_POLL_S: Final = 0.2
_END_S: Final = 10.0
_STDERR_BYTES: Final = 400
"""Bytes of stderr in which the last line is looked for."""


class ProcessGone(Exception):
    """The process cannot be started, has died or does not answer."""


class ProcessKilled(ProcessGone):
    """The process was killed by SIGKILL, perhaps because memory ran out."""


class WorkerProcess:
    """A process that runs a function. A context manager, which kills the process."""

    def __init__(
        self,
        main: Callable[..., None],
        *arguments: str,
        memory: int | None = None,
        stderr: int = subprocess.DEVNULL,
    ) -> None:
        """Run ``main(connection, *arguments)``, a function of a module. The number of the
        ``memory`` (`unnamed_memory`) comes before the arguments. Raises ProcessGone.

        The process has the ``sys.path`` of this one, without the current folder. By default its
        stderr is dropped: where this process then does the work, it reports the same error.
        """
        from multiprocessing import Pipe  # slow to import, and few commands start a process

        entries: list[object] = [*sys.path]
        path = [entry for entry in entries if isinstance(entry, str)]  # as the import system does
        try:
            self.connection, theirs = Pipe()
            with theirs:
                files = (theirs.fileno(),) if memory is None else (theirs.fileno(), memory)
                name = f"{main.__module__}:{main.__qualname__}"
                words = [json.dumps(path), name, *map(str, files), *arguments]
                self._process = subprocess.Popen(  # noqa: S603 (our own code)
                    [sys.executable, "-P", "-c", _PROGRAM, *words],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=stderr,
                    pass_fds=files,
                    process_group=0,
                    env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                )
        except OSError as error:
            raise ProcessGone(str(error)) from error

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    def send(self, request: bytes) -> None:
        """Send a request. Raises ProcessGone."""
        try:
            self.connection.send_bytes(request)
        except OSError as error:
            raise ProcessGone(str(error)) from error

    def has_answer(self, timeout_s: float = 0.0) -> bool:
        """Whether an answer can be received, if need be after waiting. Raises ProcessGone."""
        try:
            return self.connection.poll(timeout_s)
        except OSError as error:
            raise ProcessGone(str(error)) from error

    def receive(self) -> bytes:
        """The next answer. Raises ProcessGone."""
        try:
            return self.connection.recv_bytes()
        except (EOFError, OSError) as error:
            raise ProcessGone(str(error)) from error

    def close(self) -> None:
        """Kill the process and wait for its end."""
        self.connection.close()
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _work(main: str, connection: str, *arguments: str) -> None:
    """Run in the process: call ``main`` until it returns or the connection is closed."""
    from multiprocessing.connection import Connection

    module, _, name = main.partition(":")
    function = getattr(import_module(module), name)
    with contextlib.suppress(EOFError, ConnectionError), Connection(int(connection)) as requests:
        function(requests, *arguments)


@contextlib.contextmanager
def unnamed_memory(size: int) -> Iterator[int]:
    """The descriptor of an unnamed file of ``size`` bytes, in memory if the system has such
    files."""
    has_memory_files = hasattr(os, "memfd_create")
    with (
        os.fdopen(os.memfd_create("mapfold"), "r+b")
        if has_memory_files
        else tempfile.TemporaryFile() as file
    ):
        file.truncate(size)
        yield file.fileno()


class Called(NamedTuple, Generic[T]):
    """The outcome of a call, by its number from 0: its result, or the error that it raised, which
    is a ProcessGone where each of its processes died. ``attempts`` counts these."""

    number: int
    result: T | None
    error: Exception | None
    attempts: int


def call_in_processes(
    calls: Sequence[Call[T]], workers: int, progress: Report | None = None, *, attempts: int = 1
) -> Iterator[Called[T]]:
    """Make calls in ``workers`` processes; yields the outcome of each as soon as it has ended.

    A call whose process died is made again in a new one, ``attempts`` times in all at most; other
    calls go on meanwhile. ``progress`` receives the sum of what the calls report, several times a
    second. Raises ProcessGone if a process cannot be started. The processes are killed when the
    iterator is closed.
    """
    from multiprocessing.connection import wait

    waiting = deque(range(len(calls)))
    made, reported = [0] * len(calls), [0] * len(calls)
    running: dict[object, tuple[_CallingProcess, int]] = {}
    idle: list[_CallingProcess] = []
    with contextlib.ExitStack() as stack:
        while waiting or running:
            while waiting and len(running) < workers:
                number = waiting.popleft()
                idle = [each for each in idle if not each.has_answer()]  # the end of one that died
                process = idle.pop() if idle else _start_calling(stack)
                running[process.connection] = process, number
                made[number] += 1
                process.begin(calls[number])
            for connection in wait([each.connection for each, _ in running.values()], _POLL_S):
                process, number = running[connection]
                answer = process.answer()
                reported[number] = answer.reported
                if not answer.is_end:
                    continue
                del running[connection]
                if not isinstance(answer.error, ProcessGone):
                    idle.append(process)
                elif made[number] < attempts:
                    waiting.appendleft(number)
                    continue
                yield Called(number, answer.result, answer.error, made[number])
            if progress is not None:
                progress(sum(reported))


class _Answer(NamedTuple):
    """Of a call that goes on or, ``is_end``, has ended: what it has reported, result and error."""

    reported: int
    is_end: bool = False
    result: Any = None
    error: Exception | None = None


class _CallingProcess(WorkerProcess):
    """A process that makes call after call."""

    def __init__(self, stderr: int) -> None:
        super().__init__(_make_calls, stderr=stderr)
        self._stderr = stderr

    def begin(self, call: Call[Any]) -> None:
        """Assign a call. If the process has died, `answer` says so."""
        with contextlib.suppress(OSError):
            self.connection.send(call)

    def answer(self) -> _Answer:
        """The next answer; the end of the call if the process has died."""
        try:
            answer: _Answer = self.connection.recv()
        except (EOFError, OSError):
            error = self._end()
            self.close()
            return _Answer(0, is_end=True, error=error)
        return answer

    def _end(self) -> ProcessGone:
        """How the process, which has closed its connection, ended: its signal or exit status, and
        the last line that it wrote to stderr."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        code = self._process.poll()
        if code == -signal.SIGKILL:
            return ProcessKilled("killed")
        how = "no answer"
        if code is not None:
            how = f"exit code {code}" if code >= 0 else str(signal.strsignal(-code))
        size = os.fstat(self._stderr).st_size
        said = os.pread(self._stderr, _STDERR_BYTES, max(0, size - _STDERR_BYTES))
        *_, last = ["", *said.decode(errors="replace").strip().splitlines()]
        return ProcessGone(f"{how}: {last}" if last else how)


def _start_calling(stack: contextlib.ExitStack) -> _CallingProcess:
    try:
        stderr = stack.enter_context(unnamed_memory(0))
    except OSError as error:
        raise ProcessGone(str(error)) from error
    return stack.enter_context(_CallingProcess(stderr))


def _make_calls(connection: "Connection") -> None:
    """Run in the process. It ends at once when the connection is closed, even within a call."""
    requests: SimpleQueue[bytes] = SimpleQueue()
    threading.Thread(target=_receive, args=(connection, requests), daemon=True).start()
    gc.freeze()
    while True:
        connection.send_bytes(_made(requests.get(), connection))


def _receive(connection: "Connection", requests: SimpleQueue[bytes]) -> None:
    try:
        while True:
            requests.put(connection.recv_bytes())
    except (EOFError, OSError):
        os._exit(1)


def _made(request: bytes, connection: "Connection") -> bytes:
    import pickle

    reported, next_s = 0, 0.0

    def report(done: int) -> None:
        nonlocal reported, next_s
        reported, now_s = done, time.monotonic()
        if now_s >= next_s:
            next_s = now_s + _REPORT_S
            connection.send(_Answer(reported))

    try:
        result = pickle.loads(request)(report)  # noqa: S301 (from the process that started this)
        return pickle.dumps(_Answer(reported, is_end=True, result=result))
    except BaseException as error:  # noqa: BLE001 (raised by whoever asked)
        return pickle.dumps(_Answer(reported, is_end=True, error=_portable(error)))


def _portable(error: BaseException) -> Exception:
    """The error, or one with its text if it cannot be sent or ends programs (SystemExit, a panic of
    Rust)."""
    import pickle

    if isinstance(error, Exception):
        with contextlib.suppress(Exception):  # whatever its own methods raise
            pickle.loads(pickle.dumps(error))  # noqa: S301 (made here)
            return error
    return RuntimeError(f"{type(error).__name__}: {error}")
