"""The folders of killed test runs: their servers are stopped, and they are removed."""

import contextlib
import fcntl
import os
import re
import shutil
from pathlib import Path
from typing import IO

from projections.fold.errors import EmbeddedServerError
from projections.postgres.embedded import EmbeddedServer

_NAME = re.compile(r"mapfold-test-([0-9]+)")
_LOCK = "run.lock"


def hold_run(home: Path) -> IO[bytes]:
    """Make the folder of a run, which is kept as long as one of its processes has this file open.
    The kernel closes it, however a process ends."""
    home.mkdir(parents=True, exist_ok=True)
    held = (home / _LOCK).open("ab")
    fcntl.flock(held, fcntl.LOCK_SH)
    return held


def remove_killed_runs(parent: Path) -> list[Path]:
    """Remove the folders of runs of which no process is left; returns them.

    Both must say so, the lock and the number in the name: a run that has just begun has no lock
    yet, and the workers of a killed one go on for a moment.
    """
    removed = []
    for folder in sorted(parent.glob("mapfold-test-*")):
        named = _NAME.fullmatch(folder.name)
        if named is None or _is_alive(int(named[1])):
            continue
        with contextlib.suppress(OSError, EmbeddedServerError), (folder / _LOCK).open("ab") as held:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)  # BlockingIOError: somebody has it
            homes = [folder, *(data.parent for data in folder.glob("*/pg"))]
            if not any(EmbeddedServer(home).stop(discard_keep=True) for home in homes):
                shutil.rmtree(folder)
                removed.append(folder)
    return removed


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
