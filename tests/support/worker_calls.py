"""Calls that worker processes import and make."""

import os
import signal
import threading
from pathlib import Path
from typing import NoReturn

from eventsrc.base.worker_process import Report


def double(number: int, report: Report) -> int:
    """Twice the number, which is reported."""
    report(number)
    return 2 * number


def killed(folder: Path, number: int, times: int, _: Report) -> int:
    """Append to the number's file in the folder, then be killed the first ``times``."""
    with (folder / str(number)).open("a") as file:
        file.write("x")
    if (folder / str(number)).stat().st_size <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def fails(number: int, _: Report) -> NoReturn:
    """Raise an error."""
    raise ValueError(f"no {number}")


def quits(_: Report) -> NoReturn:
    """End the program."""
    raise SystemExit("enough")


def process_id(_: Report) -> int:
    """The worker's id."""
    return os.getpid()


class Unportable(Exception):
    """An error that cannot be unpickled."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(f"{one} and {other}")


def fails_unportably(_: Report) -> NoReturn:
    """Raise an error that cannot be sent."""
    raise Unportable(1, 2)


def answers_unportably(_: Report) -> threading.Lock:
    """A result that cannot be sent."""
    return threading.Lock()


def aborts(_: Report) -> NoReturn:
    """End as faulty native code does."""
    os.write(2, b"some\nheap: corrupted\n\n")
    os.abort()


def fails_in_turn(folder: Path, names: list[str], _: int, report: Report, **__: object) -> NoReturn:
    """Raise an error of the first name; ``first`` waits until a file ``go`` is in the folder."""
    report(1)
    report(2)
    while names[0] == "first" and not (folder / "go").exists():
        threading.Event().wait(0.01)
    raise ValueError(names[0])


def wait(folder: Path, report: Report) -> None:
    """Write the process's id, then wait forever."""
    report(7)
    (folder / "pid.new").write_text(str(os.getpid()))
    (folder / "pid.new").rename(folder / "pid")
    threading.Event().wait()
