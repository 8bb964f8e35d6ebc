"""The growing segment, written side.

    magic · Header · Metadata "mapfold.segment" · ( chunk · commit mark )*

One commit is: write one uncompressed chunk, sync it, write its commit mark. The mark is what a
reader in another process goes by: a chunk without one may not be on the disk yet and is not shown.
The mark itself needs no sync, for it says something only while the bytes before it are there; and
recovery, which has no writer to race with, takes every chunk whose CRC holds, mark or not. Only the
last mark of a segment is synced before the next segment begins: without it a reader would find the
next one's events and not those before them.

A commit that fails leaves the file at the last good byte, and the segment refuses further work. So
it does when somebody has deleted the file: nothing may be called recorded that has no name.
"""

import errno
import os
from collections.abc import Sequence
from pathlib import Path

from eventsrc.errors import LogError

from ._group import Group, GroupBuilder
from ._head import file_head, head_metadata
from ._naming import ACTIVE, NEW, segment_path
from .event import NewEvent
from .fsync import FsyncPolicy, replace_durably, sync_file, write_all


class ActiveSegment:
    """Events go in by `take` and count once `commit` has returned.

    Or, with another thread to do it: once that thread's `write` of what `cut` gave has returned.
    Groups must be written in the order they were cut in, one at a time.
    """

    def __init__(
        self, log: Path, log_id: str, base: int, policy: FsyncPolicy, slack: int = 1
    ) -> None:
        self.path = segment_path(log, base, ACTIVE)
        self.base = base
        self.committed = base
        self.size = 0
        self._temporary = segment_path(log, base, NEW)
        self._head = file_head(head_metadata(log_id, base))
        self._syncs = policy.syncs
        self._group = GroupBuilder(base, policy, slack)
        self._failure: str | None = None
        self._fd = -1

    def create(self) -> None:
        """Make the file, before the first `write`; events may be taken earlier. Raises OSError."""
        fd = os.open(self._temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            write_all(fd, self._head)
            sync_file(fd)
        finally:
            os.close(fd)
        replace_durably(self._temporary, self.path)
        self._fd = os.open(self.path, os.O_WRONLY | os.O_APPEND)
        self.size = len(self._head)

    @property
    def next_offset(self) -> int:
        """The offset the next event gets."""
        return self._group.next_offset

    @property
    def waiting(self) -> int:
        """Events taken and not committed."""
        return self.next_offset - self.committed

    @property
    def channels(self) -> int:
        """How many keys, each of one version, it has so far."""
        return self._group.channels

    def take(self, events: Sequence[NewEvent], start: int) -> int:
        """Take events from index ``start`` on until a commit is needed; how many were taken."""
        self._check()
        return self._group.take(events, start)

    def due(self) -> bool:
        """True when the policy wants a commit now."""
        self._check()
        return self._group.due()

    def full(self) -> bool:
        """True when nothing more can be taken before a commit."""
        return self._group.full()

    def cut(self) -> Group:
        """Everything taken and not yet cut, for `write`."""
        return self._group.cut()

    def commit(self) -> None:
        """Bring everything taken to the disk, then say so. Raises LogError; then all is as before
        the commit, and no further work is taken."""
        self._check()
        if self._group.waiting:
            self.write(self._group.cut())

    def write(self, group: Group) -> None:
        """Bring one group to the disk, then say so. Raises LogError."""
        self._check()
        head, body, mark = group.pieces()
        try:
            write_all(self._fd, head)
            write_all(self._fd, body)
            if self._syncs:
                sync_file(self._fd)
            write_all(self._fd, mark)
            gone = os.fstat(self._fd).st_nlink == 0
        except OSError as error:
            raise self._fail(error) from error
        except BaseException:  # Ctrl-C: what is half written must have nothing behind it
            self._fail(InterruptedError(errno.EINTR, "interrupted"))
            raise
        if gone:
            raise self._deleted()
        self.size += len(head) + len(body) + len(mark)
        self.committed = group.following

    def end(self, rest: Group) -> None:
        """Write the last group, and make the mark of the last commit survive a power cut. Raises
        LogError, or OSError when it is only the mark."""
        if rest.following > rest.first:
            self.write(rest)
        if self._syncs:
            sync_file(self._fd)
        self.close()

    def _check(self) -> None:
        if self._failure is not None:
            raise LogError(self._failure)

    def _fail(self, error: OSError) -> LogError:
        """Cut off what is half written. After a failed sync nobody knows which pages are on the
        disk, and after a full disk the next write fails as well: the writer must start anew."""
        message = (
            f"{self.path}: {error.strerror or error}: {self.waiting} events from offset "
            f"{self.committed} on could not be written; every event before it is safe. "
            "Free space or fix the disk, then start again"
        )
        try:
            os.ftruncate(self._fd, self.size)
        except OSError as cut_error:
            message += f" (the torn end stays: {cut_error.strerror}; recovery ignores it)"
        return self.refuse(message)

    def _deleted(self) -> LogError:
        """A file without a name takes everything and keeps nothing."""
        return self.refuse(
            f"{self.path} was deleted while it was being written: offsets {self.base} to "
            f"{self.next_offset - 1} are lost. Keep others away from {self.path.parent} and start "
            "again"
        )

    def refuse(self, message: str) -> LogError:
        """From now on every append and commit raises this."""
        self._failure = message
        return LogError(message)

    def close(self) -> None:
        """Let go of the file. Does not commit."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
