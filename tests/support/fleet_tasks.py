"""Tasks that worker processes of a fleet's engine import and run."""

import os
import signal
import threading
from pathlib import Path
from typing import NoReturn

from projections.adapters.fleet.engines import Progress


def double(number: int, progress: Progress) -> int:
    """Twice the number."""
    progress(number)
    return 2 * number


def killed(request: tuple[Path, int, int], _: Progress) -> int:
    """Append the request's number to its file in the folder, then be killed the first ``times``."""
    folder, number, times = request
    with (folder / str(number)).open("a") as file:
        file.write("x")
    if (folder / str(number)).stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def fails(number: int, _: Progress) -> NoReturn:
    """A fault."""
    raise RuntimeError(f"no {number}\x1b[31m")


def wait(folder: Path, _: Progress) -> None:
    """Write the process's id, then wait forever."""
    (folder / "pid.new").write_text(str(os.getpid()))
    (folder / "pid.new").rename(folder / "pid")
    threading.Event().wait()
