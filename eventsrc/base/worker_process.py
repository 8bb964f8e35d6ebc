"""A worker process that receives requests and sends answers over a connection.

It keeps no state, so it may be killed at any moment, and is killed when its context manager ends.
It has to exit when its connection is closed, which happens when this process dies. It is in a
process group of its own, so Ctrl-C in a terminal reaches this process only.

Not `multiprocessing`: its processes import the caller's main module again (the whole command line,
or a script that has no ``if __name__ == "__main__"``), and it starts another process to remove
named shared memory, which is in ``/dev/shm``, and stays there when both are killed. This memory has
no name: it is freed with the processes that use it, and not bounded by ``/dev/shm``.
"""

import contextlib
import os
import subprocess
import tempfile
from collections.abc import Iterator
from multiprocessing import Pipe
from types import TracebackType
from typing import Self

from .own_process import python_command


class ProcessGone(Exception):
    """The process cannot be started, has died or does not answer."""


class WorkerProcess:
    """A context manager. Raises ProcessGone if the process cannot be started."""

    def __init__(self, code: str, *arguments: str, memory: int) -> None:
        """Start ``code``, whose ``sys.argv[1:]`` are ``arguments``, then the numbers of the files
        of the connection and of the memory (`unnamed_memory`)."""
        try:
            self._connection, theirs = Pipe()
            with theirs:
                files = theirs.fileno(), memory
                self._process = subprocess.Popen(  # noqa: S603 (our own code)
                    python_command(code, *arguments, *map(str, files)),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,  # this process has the same problem, and reports it
                    pass_fds=files,
                    process_group=0,
                    env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
                )
        except OSError as error:
            raise ProcessGone(str(error)) from error

    def send(self, request: bytes) -> None:
        """Send a request. Raises ProcessGone."""
        try:
            self._connection.send_bytes(request)
        except OSError as error:
            raise ProcessGone(str(error)) from error

    def has_answer(self, timeout_s: float = 0.0) -> bool:
        """Whether an answer can be received, if need be after waiting. Raises ProcessGone."""
        try:
            return self._connection.poll(timeout_s)
        except OSError as error:
            raise ProcessGone(str(error)) from error

    def receive(self) -> bytes:
        """The next answer. Raises ProcessGone."""
        try:
            return self._connection.recv_bytes()
        except (EOFError, OSError) as error:
            raise ProcessGone(str(error)) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        self._connection.close()
        self._process.kill()
        self._process.wait()


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
