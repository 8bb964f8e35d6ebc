"""Start programs by forking a process that has imported their modules already.

A program started so is a process of its own, with its own arguments, folder, environment, streams
and exit code. Only the interpreter's start and most imports are shared, nine tenths of what a short
command costs. Tests of what an interpreter does at its start use `subprocess` instead.
"""

import atexit
import contextlib
import functools
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

ROOT = Path(__file__).parents[2]

MAPFOLD = "projections.surfaces.cli:main"

SHARED = "MAPFOLD_TEST_PREFORK"
"""The environment variable with the socket of the process that forks for all workers."""

# Does in ten milliseconds what the program does; for scripts that call `mapfold`.
_STAND_IN = """#!{python} -IS
import _socket, array, json, os, signal, sys
server = _socket.socket(_socket.AF_UNIX, _socket.SOCK_SEQPACKET)
server.connect({path!r})
asked = dict(entry={entry!r}, argv=sys.argv, env=dict(os.environ), cwd=os.getcwd())
request = os.memfd_create("request")
os.pwrite(request, json.dumps(asked).encode(), 0)
fds = array.array("i", [request, 0, 1, 2])
server.sendmsg([b"start"], [(_socket.SOL_SOCKET, _socket.SCM_RIGHTS, fds)])
server.recv(100)
code = int(server.recv(100))
if code < 0:
    signal.signal(-code, signal.SIG_DFL)
    os.kill(os.getpid(), -code)
sys.exit(code)
"""


class Process(Protocol):
    """What `subprocess.Popen` and `Forked` have in common and tests use."""

    @property
    def pid(self) -> int:
        """The process id."""

    returncode: Any

    def poll(self) -> int | None:
        """The exit code, None while it runs."""

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code; raises `subprocess.TimeoutExpired`."""

    def send_signal(self, sig: int) -> None:
        """Send a signal unless it has ended."""

    def kill(self) -> None:
        """SIGKILL."""


class Forked:
    """A process that the server forked, with the methods of `subprocess.Popen`."""

    def __init__(self, request: Mapping[str, Any], files: Sequence[int]) -> None:
        self._answers = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._answers.connect(_server())
        with os.fdopen(os.memfd_create("request"), "wb") as file:
            file.write(json.dumps(request).encode())
            file.flush()
            socket.send_fds(self._answers, [b"start"], [file.fileno(), *files])
        self.args = request["argv"]
        self.pid = int(self._answers.recv(100))
        self.returncode: int | None = None
        self._ending = threading.Lock()

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0.0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait for the exit code; raises `subprocess.TimeoutExpired`."""
        if self.returncode is None and not select.select([self._answers], [], [], timeout)[0]:
            raise subprocess.TimeoutExpired(self.args, timeout or 0.0)
        with self._ending:
            if self.returncode is None:
                self.returncode = int(self._answers.recv(100))
                self._answers.close()
        return self.returncode

    def send_signal(self, sig: int) -> None:
        """Send a signal unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, sig)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)


def start(
    program: str,
    argv: Sequence[str],
    *,
    env: Mapping[str, str],
    cwd: Path,
    stdin: int | None = None,
    stdout: int | None = None,
    stderr: int | None = None,
) -> Process:
    """Start ``module:function``, or Python code (what has a space), with this ``sys.argv``.

    The streams are file descriptors; without them nothing is read and what is written is lost.
    """
    what = "code" if " " in program else "entry"
    with Path(os.devnull).open("r+b") as null:
        files = [null.fileno() if fd is None else fd for fd in (stdin, stdout, stderr)]
        if not _must_be_new(env):
            request = {what: program, "argv": list(argv), "env": dict(env), "cwd": str(cwd)}
            return Forked(request, files)
        if what == "entry":
            module, function = program.split(":")
            code = "import sys; sys.argv = sys.argv[1:]; "
            program = f"{code}from {module} import {function}; {function}()"
        else:
            argv = argv[1:]
        path = filter(None, [env.get("PYTHONPATH"), str(ROOT)])
        return subprocess.Popen(
            [sys.executable, "-c", program, *argv],
            env={**env, "PYTHONPATH": os.pathsep.join(path)},
            cwd=cwd,
            stdin=files[0],
            stdout=files[1],
            stderr=files[2],
        )


def run(
    entry: str,
    argv: Sequence[str],
    *,
    env: Mapping[str, str],
    cwd: Path,
    stdin: bytes | None = None,
    timeout: float,
) -> "subprocess.CompletedProcess[bytes]":
    """Run a program as `start` does, to its end.

    Raises `subprocess.TimeoutExpired` after killing a process that takes longer than ``timeout`` s.
    """
    with (
        tempfile.TemporaryFile() as given,
        tempfile.TemporaryFile() as out,
        tempfile.TemporaryFile() as err,
    ):
        given.write(stdin or b"")
        given.seek(0)
        files = {"stdin": given.fileno(), "stdout": out.fileno(), "stderr": err.fileno()}
        process = start(entry, argv, env=env, cwd=cwd, **files)
        try:
            code = process.wait(timeout)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise
        out.seek(0)
        err.seek(0)
        return subprocess.CompletedProcess(list(argv), code, out.read(), err.read())


def folder_with_mapfold() -> Path:
    """A folder for PATH whose ``mapfold`` is forked."""
    return Path(_server()).parent


def _must_be_new(env: Mapping[str, str]) -> bool:
    """Whether the interpreter or a library reads at its start what is different in ``env``."""
    names = [
        name
        for name in {**os.environ, **env}
        if name.startswith(("PYTHON", "LC_", "LANG", "OPENBLAS", "OMP_", "NPY_", "LD_"))
        and name != "PYTHONUNBUFFERED"  # which `prefork_server` obeys
    ]
    return any(env.get(name) != os.environ.get(name) for name in names)


@functools.cache
def _server() -> str:
    """Where the process that forks listens: that of all workers, else one of its own."""
    return os.environ.get(SHARED) or start_server()


def start_server() -> str:
    """Start the process that forks, which ends with this one; returns where it listens."""
    folder = Path(tempfile.mkdtemp(prefix="mapfold-test-prefork-"))
    path = str(folder / "server")
    program = folder / "mapfold"
    program.write_text(_STAND_IN.format(python=sys.executable, path=path, entry=MAPFOLD))
    program.chmod(0o755)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.bind(path)
        listener.listen(100)
        process = subprocess.Popen(
            [sys.executable, "-m", "tests.support.prefork_server", str(listener.fileno())],
            pass_fds=[listener.fileno()],
            cwd=ROOT,
            stdin=subprocess.PIPE,
        )

    def stop() -> None:
        process.communicate()
        shutil.rmtree(folder, ignore_errors=True)

    atexit.register(stop)
    return path
