"""One writer for each log: an flock on ``LOG/lock``, which dies with the process that holds it.

The file's text names the holder for whoever comes second. The text means nothing by itself: only
the lock counts, so a file left behind by a killed writer blocks nobody.

People delete lock files. A second writer would then make a new one, lock that, and take the first
one's growing segment for left over. So the folder is locked as well, where its file system can.
"""

import contextlib
import errno
import fcntl
import json
import os
import socket
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from eventsrc.clock import Clock
from eventsrc.errors import LogBusy

from .format import LOCK

_TRIES: Final = 5
_LOOK_S: Final = 0.01
"""Who only asks whether a log is held holds it itself for some microseconds."""


class WriterLock:
    """Held from construction until `release`. Raises LogBusy naming the holder."""

    def __init__(self, log: Path, clock: Clock) -> None:
        self._folder = -1
        self._fd = os.open(log / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._folder = os.open(log, os.O_RDONLY | os.O_DIRECTORY)
            _lock(self._fd)
            _lock_folder(self._folder)
        except BlockingIOError:
            holder = _holder(self._fd)
            self._close()
            raise LogBusy(
                f"{log} is being written by {holder}; stop that writer or choose another log"
            ) from None
        except BaseException:
            self._close()
            raise
        since = datetime.fromtimestamp(clock() / 1e9, UTC).isoformat(timespec="seconds")
        text = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since})
        with contextlib.suppress(OSError):  # a full disk: the lock holds without its text
            os.ftruncate(self._fd, 0)
            os.pwrite(self._fd, text.encode(), 0)

    def release(self) -> None:
        """Let the next writer in. The file stays: deleting it would race with that writer."""
        if self._fd >= 0:
            os.ftruncate(self._fd, 0)
            self._close()

    def _close(self) -> None:
        for fd in (self._fd, self._folder):
            if fd >= 0:
                os.close(fd)
        self._fd = self._folder = -1

    def __enter__(self) -> "WriterLock":
        return self

    def __exit__(self, *_: object) -> None:
        self.release()


def _lock(fd: int) -> None:
    """Raises BlockingIOError when another holds it for longer than `is_held` takes to look."""
    for _ in range(_TRIES):
        try:
            return fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_LOOK_S)
    return fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _lock_folder(fd: int) -> None:
    try:
        _lock(fd)
    except BlockingIOError:
        raise
    except OSError as error:  # NFS locks no folders; the file is locked all the same
        if error.errno not in (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.EOPNOTSUPP):
            raise


def is_held(log: Path) -> bool:
    """Whether a writer is at work on ``log`` right now."""
    return _is_locked(log / LOCK) or _is_locked(log)


def _is_locked(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDONLY)
    except OSError:  # no lock, or a log of somebody else's that may only be read
        return False
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a folder on NFS
        return False
    finally:
        os.close(fd)
    return False


def _holder(fd: int) -> str:
    try:
        text = json.loads(os.pread(fd, 4096, 0))
        return f"process {text['pid']} on {text['host']} since {text['since']}"
    except (ValueError, KeyError, TypeError):  # caught between its open and its first line
        return "another process"
