"""When events reach the disk for good, and the calls that put them there.

``always``   every event is synced before `append` returns
``<N>ms``    group commit: events are written and synced together every N milliseconds, or sooner
             when 256 events or 4 MiB wait (``50ms`` is the default)
``never``    written every 50 ms and left to the operating system: survives kill -9, not a power cut
"""

import contextlib
import errno
import os
import re
import shutil
from dataclasses import dataclass
from pathlib import Path

from eventsrc.errors import MisuseError

GROUP_EVENTS = 256
GROUP_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True, slots=True)
class FsyncPolicy:
    """How many events, bytes and nanoseconds may wait for a commit, and whether it syncs."""

    interval_ns: int
    max_events: int = GROUP_EVENTS
    max_bytes: int = GROUP_BYTES
    syncs: bool = True


ALWAYS = FsyncPolicy(interval_ns=0, max_events=1)
GROUP_COMMIT = FsyncPolicy(interval_ns=50_000_000)
NEVER = FsyncPolicy(interval_ns=50_000_000, syncs=False)


def parse_fsync(text: str) -> FsyncPolicy:
    """``always``, ``never`` or a time such as ``50ms``."""
    if text == "always":
        return ALWAYS
    if text == "never":
        return NEVER
    match = re.fullmatch(r"(\d{1,6})ms", text)
    if match is None or int(match[1]) == 0:
        raise MisuseError(f"--fsync {text!r} is none of always, never or <N>ms; try --fsync 50ms")
    return FsyncPolicy(interval_ns=int(match[1]) * 1_000_000)


def sync_file(fd: int) -> None:
    """Bytes and size of an open file to stable storage. The size is part of fdatasync's promise."""
    getattr(os, "fdatasync", os.fsync)(fd)


def sync_directory(path: Path) -> None:
    """Make a created, renamed or deleted name in ``path`` survive a power cut."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def make_directory_durably(path: Path) -> None:
    """Make ``path``, and what it stands in, so that a power cut takes none of them. One that is
    there already may have been made a moment before a power cut: its name is synced all the same.
    """
    if not path.parent.exists():
        make_directory_durably(path.parent)
    path.mkdir(exist_ok=True)
    with contextlib.suppress(PermissionError):  # it stands in a folder that is not for us to read
        sync_directory(path.parent)


def write_all(fd: int, data: bytes) -> None:
    """Write every byte; the system may take fewer at a time."""
    view = memoryview(data)
    while view:
        view = view[os.write(fd, view) :]


def replace_durably(temporary: Path, final: Path) -> None:
    """Rename a synced file to its name and sync the name."""
    temporary.replace(final)
    sync_directory(final.parent)


def keep_copy(path: Path, copy: Path) -> None:
    """Give a file a second name, or where its file system knows none (exFAT), copy and sync it.
    Raises FileExistsError when the name is taken."""
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
    """Delete a file if it is there, so that not even a power cut brings it back. Raises OSError."""
    unlink_quietly(path)
    sync_directory(path.parent)


def unlink_quietly(path: Path) -> None:
    """Remove ``path`` if it is there."""
    with contextlib.suppress(FileNotFoundError):
        path.unlink()
