"""One writer for each log: an flock on ``LOG/lock``, which dies with the process that holds it.

The file's text names the holder for whoever comes second. The text means nothing by itself: only
the lock counts, so a file left behind by a killed writer blocks nobody.
"""

import contextlib
import fcntl
import json
import os
import socket
from datetime import UTC, datetime
from pathlib import Path

from eventsrc.clock import Clock
from eventsrc.errors import LogBusy

from ._naming import LOCK


class WriterLock:
    """Held from construction until `release`. Raises LogBusy naming the holder."""

    def __init__(self, log: Path, clock: Clock) -> None:
        path = log / LOCK
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = _holder(self._fd)
            os.close(self._fd)
            raise LogBusy(
                f"{log} is being written by {holder}; stop that writer or choose another log"
            ) from None
        since = datetime.fromtimestamp(clock() / 1e9, UTC).isoformat(timespec="seconds")
        text = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since})
        with contextlib.suppress(OSError):  # a full disk: the lock holds without its text
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, text.encode(), 0)

    def release(self) -> None:
        """Let the next writer in. The file stays: deleting it would race with that writer."""
        if self._fd >= 0:
            os.ftruncate(self._fd, 0)
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> "WriterLock":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def is_held(log: Path) -> bool:
    """Whether a writer is at work on ``log`` right now."""
    try:
        fd = os.open(log / LOCK, os.O_RDONLY)
    except OSError:  # no lock, or a log of somebody else's that may only be read
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _holder(fd: int) -> str:
    try:
        text = json.loads(os.pread(fd, 4096, 0))
        return f"process {text['pid']} on {text['host']} since {text['since']}"
    except (ValueError, KeyError, TypeError):  # caught between its open and its first line
        return "another process"
