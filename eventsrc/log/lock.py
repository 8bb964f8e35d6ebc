"""Lock a log for its one writer: an flock on ``LOG/lock``, released when its process ends.

The file's text names the holder for error messages. Only the lock counts, so a file left behind by
a killed writer blocks no other. The log's folder is locked as well where the file system allows it:
if the lock file is deleted, a second writer would make a new one, lock that, and treat the
first writer's growing segment as left over.
"""

import contextlib
import errno
import fcntl
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from eventsrc.base.errors import LogBusy, LogError
from eventsrc.base.machine import Clock

from .format import LOCK

_TRIES: Final = 5
_RETRY_S: Final = 0.01
"""`is_held` itself holds the lock for some microseconds."""


class WriterLock:
    """The lock, held from construction until `release`. Raises LogBusy naming the holder."""

    def __init__(self, log: Path, clock: Clock) -> None:
        self._folder = -1
        self._fd = os.open(log / LOCK, os.O_RDWR | os.O_CREAT | os.O_NONBLOCK, 0o644)
        try:
            _check_regular(self._fd, log / LOCK)
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
        """Release the lock. The file stays: deleting it would race with the next writer."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):  # its text is then that of a holder long gone
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


def _check_regular(fd: int, path: Path) -> None:
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        raise LogError(f"{path} is no regular file; delete it")


def _lock(fd: int) -> None:
    """Raises BlockingIOError when another process holds it for longer than `is_held` does."""
    for _ in range(_TRIES):
        try:
            return fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(_RETRY_S)
    return fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _lock_folder(fd: int) -> None:
    try:
        _lock(fd)
    except BlockingIOError:
        raise
    except OSError as error:  # NFS cannot lock folders; the file is locked
        if error.errno not in (errno.EBADF, errno.EINVAL, errno.ENOLCK, errno.EOPNOTSUPP):
            raise


@contextlib.contextmanager
def file_locked(path: Path) -> Iterator[None]:
    """Wait for a lock on a file, which is made if need be; it is held for moments, or while an
    archive is asked. Raises OSError."""
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o600)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def is_held(log: Path) -> bool:
    """Whether a writer has ``log`` open now."""
    return _is_locked(log / LOCK) or _is_locked(log)


def _is_locked(path: Path) -> bool:
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:  # no lock file, or one that may not be read
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
    except (ValueError, KeyError, TypeError):  # it has not written its text yet
        return "another process"
