"""Fsync policies, and calls that write, rename and delete files durably.

``always``   every event is synced before `append` returns
``<N>ms``    group commit: events are written and synced together every N milliseconds, or sooner
             when 256 events or 4 MiB wait (``50ms`` is the default)
``never``    written every 50 ms and not synced: survives kill -9, not a power cut
"""

import contextlib
import errno
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from eventsrc.base.errors import MisuseError

GROUP_EVENTS = 256
GROUP_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class FsyncPolicy:
    """How long, and with how many events or bytes, a commit may wait, and whether it syncs."""

    interval_ns: int
    max_events: int = GROUP_EVENTS
    max_bytes: int = GROUP_BYTES
    syncs: bool = True


ALWAYS = FsyncPolicy(interval_ns=0, max_events=1)
GROUP_COMMIT = FsyncPolicy(interval_ns=50_000_000)
NEVER = FsyncPolicy(interval_ns=50_000_000, syncs=False)


def parse_fsync(text: str) -> FsyncPolicy:
    """The policy for ``always``, ``never`` or a time such as ``50ms``."""
    if text == "always":
        return ALWAYS
    if text == "never":
        return NEVER
    match = re.fullmatch(r"(\d{1,6})ms", text)
    if match is None or int(match[1]) == 0:
        raise MisuseError(f"--fsync {text!r} is none of always, never or <N>ms; try --fsync 50ms")
    return FsyncPolicy(interval_ns=int(match[1]) * 1_000_000)


def sync_file(fd: int) -> None:
    """Bring bytes and size of an open file to stable storage; fdatasync includes the size."""
    getattr(os, "fdatasync", os.fsync)(fd)


def drop_cached(fd: int, start: int, end: int) -> None:
    """Drop bytes ``start`` to ``end`` of a synced file from the page cache. They stay on the disk.
    Does nothing where the system lacks posix_fadvise (macOS)."""
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(fd, start, end - start, os.POSIX_FADV_DONTNEED)


def sync_directory(path: Path) -> None:
    """Make names that were created, renamed or deleted in ``path`` survive a power cut."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def make_directory_durably(path: Path) -> None:
    """Make ``path`` and its parents so that they survive a power cut. Names of existing folders are
    synced too, since they may have been made a moment ago.
    """
    if not path.parent.exists():
        make_directory_durably(path.parent)
    path.mkdir(exist_ok=True)
    with contextlib.suppress(PermissionError):  # its parent may not be readable
        sync_directory(path.parent)


def write_all(fd: int, data: bytes) -> None:
    """Write all of ``data``, in as many calls as the system needs."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def replace_durably(temporary: Path, final: Path) -> None:
    """Rename a synced file to ``final`` and sync the folder."""
    temporary.replace(final)
    sync_directory(final.parent)


def keep_copy(path: Path, copy: Path) -> None:
    """Hard-link ``path`` to ``copy``, or copy and sync it where the file system has no hard links
    (exFAT). Raises FileExistsError when ``copy`` exists."""
    try:
        copy.hardlink_to(path)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK):
            raise
        _copy_durably(path, copy)


def _copy_durably(path: Path, copy: Path) -> None:
    with path.open("rb") as source, copy.open("xb") as target:
        try:
            shutil.copyfileobj(source, target)
            target.flush()
            sync_file(target.fileno())
        except OSError:
            copy.unlink()
            raise


def delete_durably(path: Path) -> None:
    """Delete a file if it exists and sync the folder. Raises OSError."""
    unlink_quietly(path)
    sync_directory(path.parent)


def unlink_quietly(path: Path) -> None:
    """Delete ``path`` if it exists."""
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
