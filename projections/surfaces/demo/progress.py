"""Wait on a machine of any speed, as long as there is progress.

On a busy machine a fixed deadline would end work that proceeds. Waiting ends when the observed
values have not changed for a while.
"""

import os
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Final

STALLED_S: Final = 60.0
"""Waiting ends after this time without any progress."""
LEAST_CPU_S: Final = 0.6
"""The processor time that counts as progress: 1 % of a processor in `STALLED_S`. A process that
only waits for messages uses less."""


class Progress:
    """Watches whether the values of ``observe`` still change."""

    def __init__(
        self,
        observe: Callable[[], Hashable],
        stalled_s: float = STALLED_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._observe, self._clock, self._stalled_s = observe, clock, stalled_s
        self._seen = observe()
        self._since = clock()

    def is_stalled(self) -> bool:
        """Whether nothing has changed for ``stalled_s`` seconds. To be called again and again."""
        seen = self._observe()
        if seen != self._seen:
            self._seen, self._since = seen, self._clock()
        return self._clock() - self._since > self._stalled_s


def size_of(path: Path) -> int:
    """Bytes of a file, or of the files in a folder; 0 if it is not there. Files may come and go."""
    try:
        files = list(path.iterdir()) if path.is_dir() else [path]
    except OSError:
        return 0
    return sum(_file_size(file) for file in files)


def _file_size(file: Path) -> int:
    try:
        return file.stat().st_size
    except OSError:
        return 0


def cpu_steps(pid: int) -> int:
    """The processor time of a process in units of `LEAST_CPU_S`; 0 on systems other than Linux, and
    when the process has ended."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text("ascii", "replace").rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, ValueError, IndexError):
        return 0
    return int(ticks / os.sysconf("SC_CLK_TCK") / LEAST_CPU_S)
