"""A real `mapfold` command in a process of its own: its exit code, its stderr, its peak memory."""

import contextlib
import resource
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from tests.support.fixtures_zenoh import Program

PATIENCE_S = 90.0
"""Longer than any command here takes on a busy machine; only a broken one is waited for so long."""
DESCRIPTORS = 1_024
"""How many files and sockets a command may have open: what a shell gives on most machines."""
ADDRESSES = 6 * 1024**3
"""Bytes of address space, so that a command that takes too much harms itself and not the machine.
Far more than 600 MB: threads and libraries take addresses that they never use."""
_FAULTS = ("Traceback (most recent call last)", "panicked at", "PanicException", "Fatal Python")
_MAPFOLD = """
import atexit, pathlib, sys
peak = pathlib.Path(sys.argv.pop(1))
atexit.register(lambda: peak.write_bytes(pathlib.Path("/proc/self/status").read_bytes()))
from projections.surfaces.cli import main
main()
"""
"""`mapfold`, which leaves its memory's numbers behind: a parent is told none, only its own."""


class AttackedCommand(Program):
    """`mapfold ARGUMENTS`, in the ``role`` of recorder, reader, server or router. Linux only."""

    def __init__(
        self, role: str, arguments: Sequence[str], *, env: Mapping[str, str], cwd: Path
    ) -> None:
        self.role = role
        self.command = f"mapfold {' '.join(arguments)}"
        self._peak_mb = 0.0
        self._folder = tempfile.TemporaryDirectory(prefix="mapfold-attacked-")
        self._status = Path(self._folder.name) / "status"
        self._stdout = (Path(self._folder.name) / "stdout").open("w+")
        super().__init__(
            _MAPFOLD,
            [str(self._status), *arguments],
            stdout=self._stdout.fileno(),
            env=env,
            cwd=cwd,
        )
        # The attacker's own limit is higher: it holds one end of each of very many connections.
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        self._limit(resource.RLIMIT_NOFILE, DESCRIPTORS, most)
        self._limit(resource.RLIMIT_AS, ADDRESSES, ADDRESSES)

    def _limit(self, what: int, soft: int, hard: int) -> None:
        with contextlib.suppress(ProcessLookupError):  # it is so short that it has ended
            resource.prlimit(self.process.pid, what, (soft, hard))

    def peak_mb(self) -> float:
        """The most memory it has taken by now, in MB. Ask before it is killed."""
        for status in (Path(f"/proc/{self.process.pid}/status"), self._status):
            if status.exists():
                self._peak_mb = max(self._peak_mb, _high_water_mb(status))
        return self._peak_mb

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        return self.process.poll() is None

    def kill(self) -> None:
        """SIGKILL; returns when it is gone."""
        self.peak_mb()
        self.process.kill()
        self.wait()

    def wait(self, timeout_s: float = PATIENCE_S) -> int:
        """The exit code. Kills it and raises TimeoutExpired when it does not end in time."""
        try:
            code = self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.kill()
            raise
        self._reader.join()
        self.peak_mb()
        return code

    def faults(self) -> list[str]:
        """The lines of stderr that no person should see."""
        return [line for line in self.lines if any(fault in line for fault in _FAULTS)]

    def output(self) -> str:
        """What it wrote to stdout."""
        self._stdout.seek(0)
        return self._stdout.read()

    def close(self) -> None:
        """Make sure that nothing is left behind."""
        super().close()
        self._stdout.close()
        self._folder.cleanup()


def _high_water_mb(status: Path) -> float:
    """VmHWM, which a process that is gone has none of."""
    try:
        lines = status.read_text().splitlines()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return max((int(s.split()[1]) * 1024 / 1e6 for s in lines if s.startswith("VmHWM:")), default=0)
