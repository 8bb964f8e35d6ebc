"""mapfold commands as child processes that end with the demo, also when it is killed."""

import subprocess
import sys
import threading
from collections.abc import Callable, Hashable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from eventsrc.errors import MapfoldError

from .progress import STALLED_S, Progress, cpu_steps, size_of

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

    def wait(
        self,
        observe: Callable[[], Hashable],
        *,
        working: Sequence[str] = (),
        stalled_s: float = STALLED_S,
    ) -> None:
        """Wait until all have ended, however long it takes while there is progress: what
        ``observe`` returns changes, one of them ends or writes to stderr, or one that is named in
        ``working`` uses its processor. Raises MapfoldError if one fails or there is none for
        ``stalled_s`` seconds."""

        def seen() -> Hashable:
            written = tuple(map(size_of, self._stderr.values()))
            return observe(), written, tuple(self._names_running()), self._cpu_steps(working)

        progress = Progress(seen, stalled_s)
        pause = threading.Event()
        while names := self._names_running():
            self._check()
            if progress.is_stalled():
                raise MapfoldError(
                    f"mapfold {' and '.join(names)} made no progress for {stalled_s:g} s; "
                    f"see {self._stderr[names[0]]}"
                )
            pause.wait(_POLL_S)
        self._check()

    def wait_for_output(self, name: str, text: str, stalled_s: float = STALLED_S) -> None:
        """Wait until ``name`` has written ``text`` to stderr, while it writes or uses its
        processor; raises as `wait` does."""
        file = self._stderr[name]
        progress = Progress(lambda: (size_of(file), self._cpu_steps([name])), stalled_s)
        pause = threading.Event()
        while text not in file.read_text("utf-8", "replace"):
            self._check()
            if progress.is_stalled():
                raise MapfoldError(
                    f"mapfold {name} did not start: no progress for {stalled_s:g} s; see {file}"
                )
            pause.wait(_POLL_S)

    def _names_running(self) -> list[str]:
        return [name for name, process in self._running.items() if process.poll() is None]

    def _cpu_steps(self, names: Sequence[str]) -> tuple[int, ...]:
        return tuple(cpu_steps(self._running[name].pid) for name in names)

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
