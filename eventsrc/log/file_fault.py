"""Is the file under a growing segment's name still the one that its writer has open, and as long as
what was written to it?

Somebody may delete, rename, replace, cut short or lengthen it. What is overwritten in place, at the
same length, cannot be seen so; the checksums find that when it is read.
"""

import os
import stat
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from eventsrc.envelope import Offset

from .format import DAMAGED, free_name


class Identity(NamedTuple):
    """What tells one file or folder from another."""

    device: int
    inode: int


class Found(NamedTuple):
    """What is wrong with a file; ``whole`` when all that was written is still there in its place
    and something stands behind it."""

    text: str
    whole: bool = False


@dataclass(frozen=True, slots=True)
class FileFault:
    """The file at ``path`` was given up by its writer, who goes on in the file of offset
    ``following``. Offsets ``base`` to before ``following`` had been recorded in it; ``lost`` says
    whether they can no longer be relied on."""

    path: Path
    base: Offset
    following: Offset
    found: str
    lost: bool

    @property
    def lost_events(self) -> int:
        """How many recorded events are lost, at most: some may still be read."""
        return self.following - self.base if self.lost else 0

    def __str__(self) -> str:
        if not self.lost_events:
            return f"{self.path} {self.found}; no recorded event of it is lost"
        return (
            f"{self.path} {self.found}: offsets {self.base} to {self.following - 1}, which had "
            "been recorded in it, are lost"
        )


def identity_of(path: Path) -> Identity:
    """That of a file or folder. Raises OSError."""
    status = path.stat()
    return Identity(status.st_dev, status.st_ino)


def fault_of(fd: int, path: Path, size: int) -> Found | None:
    """What is wrong with the open file ``fd``, which should stand at ``path`` and be ``size`` bytes
    long. Raises OSError."""
    ours = os.fstat(fd)
    try:
        named = identity_of(path)
    except FileNotFoundError:
        if ours.st_nlink == 0:
            return Found("was deleted")
        return Found("was renamed or moved away (put it back when the recording has ended)")
    if named != Identity(ours.st_dev, ours.st_ino):
        return Found("was replaced by another file")
    if ours.st_size < size:
        return Found(f"was cut short to {ours.st_size:,} of {size:,} bytes")
    if ours.st_size > size:
        more = ours.st_size - size
        return Found(f"has {more:,} bytes at its end that another program wrote", whole=True)
    return None


def set_aside(path: Path) -> None:
    """Rename what stands at ``path``, if anything does, as recovery names what it replaces."""
    if path.exists():
        path.rename(free_name(path, DAMAGED))


def is_readable_segment(path: Path, head_size: int) -> bool:
    """Whether a file stands at ``path`` in which some events might still be read."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size > head_size
