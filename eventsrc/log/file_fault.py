"""Check that a growing segment's file was not deleted, renamed, replaced, cut short or lengthened.

The file under its name must be the one that the writer has open, and as long as what was written to
it. Bytes overwritten in place are not noticed here; the checksums find them on reading.
"""

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from eventsrc.envelope.model import Offset

from .format import DAMAGED, free_name


class Identity(NamedTuple):
    """Identifies a file or folder."""

    device: int
    inode: int


class Problem(NamedTuple):
    """The fault of a file; ``whole`` if everything written to it is still in its place and
    other bytes follow."""

    text: str
    whole: bool = False


@dataclass(frozen=True, slots=True)
class FileFault:
    """The file at ``path``, which its writer gave up to go on in a new one.

    Offsets ``base`` to before ``following`` had been recorded in it; the new file begins at
    ``following``. ``lost`` if they can no longer be relied on.
    """

    path: Path
    base: Offset
    following: Offset
    found: str
    lost: bool

    @property
    def lost_events(self) -> int:
        """How many recorded events are lost at most; some may still be readable."""
        return self.following - self.base if self.lost else 0

    def __str__(self) -> str:
        if not self.lost_events:
            return f"{self.path} {self.found}; no recorded event of it is lost"
        return (
            f"{self.path} {self.found}: offsets {self.base} to {self.following - 1}, which had "
            "been recorded in it, are lost"
        )


def identity_of(path: Path) -> Identity:
    """Device and inode of a file or folder. Raises OSError."""
    status = path.stat()
    return Identity(status.st_dev, status.st_ino)


def find_problem(fd: int, path: Path, size: int) -> Problem | None:
    """The problem of the open file ``fd``, which should be at ``path`` and ``size`` bytes long;
    None if there is none. Raises OSError."""
    ours = os.fstat(fd)
    try:
        named = identity_of(path)
    except FileNotFoundError:
        if ours.st_nlink == 0:
            return Problem("was deleted")
        return Problem("was renamed or moved away (put it back when the recording has ended)")
    if named != Identity(ours.st_dev, ours.st_ino):
        return Problem("was replaced by another file")
    if ours.st_size < size:
        return Problem(f"was cut short to {ours.st_size:,} of {size:,} bytes")
    if ours.st_size > size:
        more = ours.st_size - size
        return Problem(f"has {more:,} bytes at its end that another program wrote", whole=True)
    return None


def quarantine(path: Path) -> None:
    """Rename the file at ``path``, if there is one, to ``….damaged``, as recovery does."""
    if path.exists():
        path.rename(free_name(path, DAMAGED))


def is_readable_segment(path: Path, head_size: int) -> bool:
    """Whether the file at ``path`` is long enough to hold readable events."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size > head_size
