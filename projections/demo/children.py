"""mapfold commands as child processes that end with the demo, also when it is killed."""

import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from eventsrc.errors import MapfoldError

_END_S: Final = 10.0
_POLL_S: Final = 0.05


class Children:
    """Child processes that end with the ``with`` block: terminated, after 10 s killed."""

    def __init__(self) -> None:
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._stderr: dict[str, Path] = {}

    def start(self, name: str, arguments: Sequence[str], stderr: Path) -> None:
        """Start ``mapfold *arguments``; its stderr goes to the file ``stderr``."""
        with stderr.open("wb") as errors:
            self._running[name] = subprocess.Popen(  # noqa: S603  # our own program and arguments
                [sys.executable, "-m", "projections.cli.child_process", *arguments],
                stdin=subprocess.PIPE,  # its end stops the child process
                stdout=subprocess.DEVNULL,
                stderr=errors,
            )
        self._stderr[name] = stderr

    def wait(self, timeout_s: float) -> None:
        """Wait until all have ended. Raises MapfoldError if one fails or takes too long."""
        deadline = time.monotonic() + timeout_s
        pause = threading.Event()
        while any(process.poll() is None for process in self._running.values()):
            self._check()
            if time.monotonic() > deadline:
                slow = [name for name, p in self._running.items() if p.poll() is None]
                raise MapfoldError(
                    f"mapfold {' and '.join(slow)} did not end within {timeout_s:g} s; "
                    f"see {self._stderr[slow[0]]}"
                )
            pause.wait(_POLL_S)
        self._check()

    def wait_for_output(self, name: str, text: str, timeout_s: float) -> None:
        """Wait until ``name`` has written ``text`` to stderr; raises as `wait` does."""
        deadline = time.monotonic() + timeout_s
        pause = threading.Event()
        while text not in self._stderr[name].read_text("utf-8", "replace"):
            self._check()
            if time.monotonic() > deadline:
                raise MapfoldError(f"mapfold {name} did not start within {timeout_s:g} s")
            pause.wait(_POLL_S)

    def _check(self) -> None:
        for name, process in self._running.items():
            code = process.poll()
            if code:
                lines = self._stderr[name].read_text("utf-8", "replace").strip().splitlines()
                last_line = lines[-1] if lines else "no output"
                raise MapfoldError(f"mapfold {name} ended with exit {code}: {last_line}")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        for process in self._running.values():
            process.terminate()  # does nothing to one that has ended
        for process in self._running.values():
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            if process.stdin is not None:
                process.stdin.close()  # not before: the end of its stdin is another SIGTERM
