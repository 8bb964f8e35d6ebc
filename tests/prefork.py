"""Start programs by forking a process that has imported their libraries already.

A command started so is a process of its own, with its own arguments, folder, environment, streams
and exit code. Only the interpreter's start and most imports are shared, four fifths of what a short
command costs; the modules of projections.cli are imported after the fork, because they look at the
environment. Under scripts/test_slow each is a new program instead.
"""

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.thorough import THOROUGH

MODULES = (
    "numpy.typing",
    "concurrent.futures.thread",
    "msgspec",
    "pydantic.main",
    "pydantic.type_adapter",
    "pydantic.types",
    "pybase64",
    "typer",
    "typer.testing",
    "rich.progress",
    "mcap.reader",
    "mcap.writer",
    "zstandard",
    "psycopg",
    "psycopg_pool",
    "pgvector.psycopg",
    "eventsrc.log",
    "projections.database",
    "projections.history",
)
ROOT = Path(__file__).parents[1]
MESSAGE_BYTES = 200_000


def run(
    entry: str,
    argv: Sequence[str],
    *,
    env: Mapping[str, str],
    cwd: Path,
    stdin: bytes | None = None,
    timeout: float,
) -> "subprocess.CompletedProcess[bytes]":
    """Call ``module:function`` in a process of its own with ``sys.argv`` set to ``argv``.

    Raises `subprocess.TimeoutExpired` after killing a process that takes longer than ``timeout`` s.
    """
    interpreter = {name: env.get(name) for name in _read_at_start({**os.environ, **env})}
    if THOROUGH or interpreter != {name: os.environ.get(name) for name in interpreter}:
        module, function = entry.split(":")
        code = f"import sys; sys.argv = sys.argv[1:]; from {module} import {function}; {function}()"
        return subprocess.run(
            [sys.executable, "-c", code, *argv],
            env={
                **env,
                "PYTHONPATH": os.pathsep.join([*env.get("PYTHONPATH", "").split(), str(ROOT)]),
            },
            cwd=cwd,
            input=stdin,
            stdin=subprocess.DEVNULL if stdin is None else None,
            capture_output=True,
            timeout=timeout,
            check=False,
        )
    with (
        tempfile.TemporaryFile() as given,
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
    ):
        given.write(stdin or b"")
        given.seek(0)
        code = _fork(
            {"entry": entry, "argv": list(argv), "env": dict(env), "cwd": str(cwd)},
            [given.fileno(), out.fileno(), err.fileno()],
            timeout,
        )
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(list(argv), code, out.read(), err.read())


def _read_at_start(env: Mapping[str, str]) -> list[str]:
    """Variables that the interpreter or a library reads when it starts."""
    return [
        name
        for name in env
        if name.startswith(("PYTHON", "LC_", "LANG", "OPENBLAS", "OMP_", "NPY_", "LD_"))
    ]


def _fork(request: Mapping[str, Any], files: Sequence[int], timeout: float) -> int:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours:
        with theirs:
            socket.send_fds(_server(), [json.dumps(request).encode()], [*files, theirs.fileno()])
        ours.settimeout(timeout)
        pid = int(ours.recv(100))
        try:
            return int(ours.recv(100))
        except TimeoutError as error:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            raise subprocess.TimeoutExpired(request["argv"], timeout) from error


@functools.cache
def _server() -> socket.socket:
    """The connection to the process that forks, started at the first use."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.prefork", str(theirs.fileno())],
            pass_fds=[theirs.fileno()],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
        )

    def stop() -> None:
        ours.close()
        process.wait()

    atexit.register(stop)
    return ours


def _serve(requests: socket.socket) -> None:
    """Fork for each request until the other end closes; a child returns from here."""
    running: dict[int, tuple[int, socket.socket]] = {}
    while True:
        ready, _, _ = select.select([requests, *running], [], [])
        for pidfd in ready:
            if pidfd in running:
                pid, answer = running.pop(pidfd)
                os.close(pidfd)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with answer, contextlib.suppress(BrokenPipeError):
                    answer.send(str(code).encode())
        if requests not in ready:
            continue
        message, fds, _, _ = socket.recv_fds(requests, MESSAGE_BYTES, 4)
        if not message:
            sys.exit(0)
        pid = os.fork()
        if pid == 0:
            requests.close()
            for pidfd, (_, answer) in running.items():
                os.close(pidfd)
                answer.close()
            _become(json.loads(message), fds)
            return
        answer = socket.socket(fileno=fds.pop())
        for fd in fds:
            os.close(fd)
        answer.send(str(pid).encode())
        running[os.pidfd_open(pid)] = (pid, answer)


def _become(request: Mapping[str, Any], fds: list[int]) -> None:
    """Take on the folder, the environment and the streams of a request."""
    global entry
    main = sys.modules["__main__"]
    main.__spec__, main.__package__ = None, ""  # so that usage texts name argv[0]
    for number, fd in enumerate(fds[:3]):
        os.dup2(fd, number)
    for fd in fds:
        os.close(fd)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", 1, errors="backslashreplace", closefd=False)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.argv = request["argv"]
    entry = request["entry"]


entry = ""

if __name__ == "__main__":
    import pydantic

    for module in MODULES:
        importlib.import_module(module)
    pydantic.create_model("First")  # has pydantic look for its plugins
    gc.collect()
    gc.freeze()
    with socket.socket(fileno=int(sys.argv[1])) as accepted:
        _serve(accepted)
    module, function = entry.split(":")
    getattr(importlib.import_module(module), function)()
