"""Write to the growing segment of a log.

    magic · Header · Metadata "mapfold.segment:…" · ( chunk · commit mark )*

One commit: write an uncompressed chunk, sync it, write its commit mark. Readers in other processes
yield a chunk only if it has a mark, so what they yield is on the disk. A mark is not synced, as a
restart and a recovery keep every chunk whose CRC is right, with or without a mark. Only the last
mark of a segment is synced, before the next segment begins: without it a reader would find the next
segment's events and not the ones before.

A commit that fails cuts the file back to the last good byte, and the segment accepts no more.

Events in a file that somebody has deleted, renamed, replaced or cut short must not count as
recorded. So each commit checks before its write and again after its sync that the file under the
segment's name is the open one and as long as what was written to it. If not, a new file begins at
the first offset of the group, and recording goes on there; no offset is used twice. The old file is
reported as a `SegmentFault`. Bytes overwritten in place are not noticed; the checksums find them on
reading.
"""

import errno
import os
import secrets
import stat
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from eventsrc.base.errors import LogError
from eventsrc.base.machine import Clock, system_clock
from eventsrc.envelope.model import Offset

from . import format as names
from .durable_files import FsyncPolicy, replace_durably, sync_file, write_all
from .event import NewEvent
from .group import Group, GroupBuilder


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
class SegmentFault:
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
        path.rename(names.free_name(path, names.DAMAGED))


def is_readable_segment(path: Path, head_size: int) -> bool:
    """Whether the file at ``path`` is long enough to hold readable events."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    return stat.S_ISREG(status.st_mode) and status.st_size > head_size


class ActiveSegment:
    """`add` events, `commit` them; they are recorded when `commit` returns.

    ``on_fault`` is called during a commit, when a file was given up and the next one exists.
    ``while_syncing`` runs the sync of a commit, and may do other work until it is done.
    """

    def __init__(
        self,
        log: Path,
        log_id: str,
        base: Offset,
        policy: FsyncPolicy,
        on_fault: Callable[[SegmentFault], None] = lambda _: None,
        while_syncing: Callable[[Callable[[], None]], None] = lambda sync: sync(),
        clock: Clock = system_clock,
        *,
        imported: bool = False,
    ) -> None:
        self.committed = base
        self.size = 0
        self._log = log
        self._log_id = log_id
        self._folder: Identity | None = None
        self._on_fault = on_fault
        self._while_syncing = while_syncing
        self._clock = clock
        self._notes = {names.IMPORTED: "1"} if imported else {}
        self._set_file(base)
        self._syncs = policy.syncs
        self._group = GroupBuilder(base, policy)
        self._failure: str | None = None
        self._fd = -1

    def _set_file(self, base: Offset) -> None:
        """Set the base offset, and the path and mark seed of the file to `create`."""
        self.base = base
        self.path = names.segment_path(self._log, base, names.ACTIVE)
        self._mark_seed = secrets.randbits(32)

    def create(self) -> None:
        """Make the file, before the first commit. Raises OSError."""
        temporary = names.segment_path(self._log, self.base, names.NEW)
        notes = {names.MARK_SEED: f"{self._mark_seed:08x}", names.BEGUN: str(max(0, self._clock()))}
        head = names.file_head(
            names.head_metadata(self._log_id, self.base, {**notes, **self._notes})
        )
        fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            write_all(fd, head)
            sync_file(fd)
        finally:
            os.close(fd)
        replace_durably(temporary, self.path)
        self._folder = identity_of(self._log)
        self._head_size = self.size = len(head)
        self._fd = os.open(self.path, os.O_RDWR | os.O_APPEND)

    @property
    def next_offset(self) -> Offset:
        """The offset the next event gets."""
        return self._group.next_offset

    @property
    def waiting(self) -> int:
        """Events added and not committed."""
        return self.next_offset - self.committed

    @property
    def channels(self) -> int:
        """Channels so far: one for each key and version, or topic and format."""
        return self._group.channels

    @property
    def definition_bytes(self) -> int:
        """Bytes of all schemas and channels so far."""
        return self._group.definition_bytes

    def add(self, events: Sequence[NewEvent], start: int) -> int:
        """Add events from index ``start`` on until a commit is needed; returns how many."""
        self._check()
        return self._group.add(events, start)

    def due(self) -> bool:
        """Whether a commit is due by the fsync policy."""
        self._check()
        return self._group.due()

    def commit(self) -> None:
        """Write and sync every event added. Raises LogError; the file is then as before the commit,
        and every further call raises the same."""
        self._check()
        if not self._group.waiting:
            return
        group = self._group.finish()
        try:
            problem = self._write(group)
            if problem is not None:
                self._begin_new_file(group.first, problem)
                problem = self._write(group)
        except OSError as error:
            raise self._fail(error) from error
        except LogError:
            raise
        except BaseException:  # Ctrl-C: nothing may be written behind a group that is half written
            self._fail(InterruptedError(errno.EINTR, "interrupted"))
            raise
        if problem is not None:
            raise self.disable(
                f"{self.path} {problem.text}, and the file before it had to be given up as well: "
                f"offsets from {group.first} on are not recorded. Keep other programs away from "
                f"{self._log} and start again"
            )

    def _write(self, group: Group) -> Problem | None:
        """Write and sync a group, which makes its events durable (with ``--fsync never``: written).

        Returns None, or what is wrong with the file; the group must then go into a new one.
        """
        problem = find_problem(self._fd, self.path, self.size)
        if problem is not None:
            return problem
        head, body, mark = group.encode(self.base, self._mark_seed)
        write_all(self._fd, head)
        write_all(self._fd, body)
        if self._syncs:
            self._while_syncing(lambda: sync_file(self._fd))
        end = self.size + len(head) + len(body)
        problem = find_problem(self._fd, self.path, end)
        if problem is not None:
            self._cut_off_group(head, end)
            return problem
        write_all(self._fd, mark)
        self.size = end + len(mark)
        self.committed = group.following
        return None

    def _cut_off_group(self, head: bytes, end: int) -> None:
        """Remove the group just appended to a file that is given up: the next file will hold it.
        The group is at the end of the file, even of one that was cut short before."""
        size = os.fstat(self._fd).st_size
        start = size - (end - self.size)
        if start >= 0 and os.pread(self._fd, len(head), start) == head:
            os.ftruncate(self._fd, start)
        elif size > self.size:
            os.ftruncate(self._fd, self.size)

    def _begin_new_file(self, first: Offset, problem: Problem) -> None:
        """Go on in a new file whose first offset is ``first``. Raises LogError if that cannot be
        made."""
        fault = SegmentFault(self.path, self.base, first, problem.text, not problem.whole)
        try:
            if self._folder != identity_of(self._log):
                raise self.disable(
                    f"{fault}; {self._log} was replaced by another folder. Put the right one back "
                    "and start again"
                )
            self.close()
            if first == self.base or not is_readable_segment(self.path, self._head_size):
                quarantine(self.path)
            self._set_file(first)
            self.create()
        except OSError as error:
            raise self.disable(
                f"{fault}; no new segment at offset {first}: {error.strerror or error}. Offsets "
                f"from there on are not recorded. Check that {self._log} is there and its disk has "
                "room, then start again"
            ) from error
        self._on_fault(fault)

    def finish(self) -> None:
        """Commit, sync the last commit mark and close the file. Raises LogError, or OSError when
        only the mark could not be synced."""
        self.commit()
        if self._syncs:
            sync_file(self._fd)
        self.close()

    def _check(self) -> None:
        if self._failure is not None:
            raise LogError(self._failure)

    def _fail(self, error: OSError) -> LogError:
        """Cut off the half-written group and `disable` the segment. After a failed sync it is
        unknown which pages are on the disk; after a full disk the next write fails as well."""
        message = (
            f"{self.path}: {error.strerror or error}: {self.waiting} events from offset "
            f"{self.committed} on could not be written; every event before it is safe. "
            "Free space or fix the disk, then start again"
        )
        try:
            if self._fd >= 0 and os.fstat(self._fd).st_size > self.size:
                os.ftruncate(self._fd, self.size)
        except OSError as cut_error:
            message += f" (the torn end stays: {cut_error.strerror}; recovery ignores it)"
        return self.disable(message)

    def disable(self, message: str) -> LogError:
        """Make every further `add`, `due` and `commit` raise ``message``; returns the error."""
        self._failure = message
        return LogError(message)

    def close(self) -> None:
        """Close the file without a commit."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
