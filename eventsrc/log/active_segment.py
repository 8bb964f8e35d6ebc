"""The growing segment, written side.

    magic · Header · Metadata "mapfold.segment" · ( chunk · commit mark )*

One commit is: write one uncompressed chunk, sync it, write its commit mark. The mark is what a
reader in another process goes by: a chunk without one may not be on the disk yet and is not shown.
The mark itself needs no sync, for it says something only while the bytes before it are there; and
recovery, which has no writer to race with, takes every chunk whose CRC holds, mark or not. Only the
last mark of a segment is synced before the next segment begins: without it a reader would find the
next one's events and not those before them.

A commit that fails leaves the file at the last good byte, and the segment refuses further work.

Nothing may be called recorded that is in a file which somebody has deleted, renamed, replaced or
cut short. So each commit checks, before it writes and once more after its sync, that the file under
the segment's name is the one that is open and as long as what was written to it. If it is not, a
new file is begun at the offset of the group at hand, which is written there, and so are the events
behind it; no offset is given twice. What was recorded in the old file is told as a `FileFault`.
"""

import errno
import os
import secrets
from collections.abc import Callable, Sequence
from pathlib import Path

from eventsrc.envelope import Offset
from eventsrc.errors import LogError

from .durable_files import FsyncPolicy, replace_durably, sync_file, write_all
from .event import NewEvent
from .file_fault import (
    FileFault,
    Found,
    Identity,
    fault_of,
    identity_of,
    is_readable_segment,
    set_aside,
)
from .format import ACTIVE, MARK_SEED, NEW, file_head, head_metadata, segment_path
from .group import Group, GroupBuilder


class ActiveSegment:
    """Events go in by `take` and count once `commit` has returned.

    Or, with another thread to do it: once that thread's `write` of what `cut` gave has returned.
    Groups must be written in the order they were cut in, one at a time.

    ``on_fault`` is called by `write` when a file was given up and the next one stands.
    """

    def __init__(
        self,
        log: Path,
        log_id: str,
        base: Offset,
        policy: FsyncPolicy,
        slack: int = 1,
        on_fault: Callable[[FileFault], None] = lambda _: None,
    ) -> None:
        self.base = base
        """The first offset, which stays when `file_base` moves on to that of a new file."""
        self.committed = base
        self.size = 0
        self._log = log
        self._log_id = log_id
        self._folder: Identity | None = None
        self._on_fault = on_fault
        self._name_file(base)
        self._syncs = policy.syncs
        self._group = GroupBuilder(base, policy, slack)
        self._failure: str | None = None
        self._fd = -1

    def _name_file(self, base: Offset) -> None:
        self.file_base = base
        self.path = segment_path(self._log, base, ACTIVE)
        self._mark_seed = secrets.randbits(32)

    def create(self) -> None:
        """Make the file, before the first `write`; events may be taken earlier. Raises OSError."""
        temporary = segment_path(self._log, self.file_base, NEW)
        seed = {MARK_SEED: f"{self._mark_seed:08x}"}
        head = file_head(head_metadata(self._log_id, self.file_base, seed))
        fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            write_all(fd, head)
            sync_file(fd)
        finally:
            os.close(fd)
        replace_durably(temporary, self.path)
        self._fd = os.open(self.path, os.O_RDWR | os.O_APPEND)
        self._folder = identity_of(self._log)
        self._head_size = self.size = len(head)

    @property
    def next_offset(self) -> Offset:
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
        try:
            found = self._write(group)
            if found is not None:
                self._begin_anew(group.first, found)
                found = self._write(group)
        except OSError as error:
            raise self._fail(error) from error
        except LogError:
            raise
        except BaseException:  # Ctrl-C: what is half written must have nothing behind it
            self._fail(InterruptedError(errno.EINTR, "interrupted"))
            raise
        if found is not None:
            raise self.refuse(
                f"{self.path} {found.text}, and the file before it had to be given up as well: "
                f"offsets from {group.first} on are not recorded. Keep other programs away from "
                f"{self._log} and start again"
            )

    def _write(self, group: Group) -> Found | None:
        """None when the group is on the disk, else what was found wrong with the file."""
        found = fault_of(self._fd, self.path, self.size)
        if found is not None:
            return found
        head, body, mark = group.pieces(self.file_base, self._mark_seed)
        write_all(self._fd, head)
        write_all(self._fd, body)
        if self._syncs:
            sync_file(self._fd)
        end = self.size + len(head) + len(body)
        found = fault_of(self._fd, self.path, end)
        if found is not None:
            self._take_back(head, end)
            return found
        write_all(self._fd, mark)
        self.size = end + len(mark)
        self.committed = group.following
        return None

    def _take_back(self, head: bytes, end: int) -> None:
        """Cut the group off that was appended to a file which is given up: it will stand in the
        next one. If the file was cut short before, the group stands at its end all the same."""
        size = os.fstat(self._fd).st_size
        start = size - (end - self.size)
        if start >= 0 and os.pread(self._fd, len(head), start) == head:
            os.ftruncate(self._fd, start)
        elif size > self.size:
            os.ftruncate(self._fd, self.size)

    def _begin_anew(self, first: Offset, found: Found) -> None:
        """Go on in a new file, whose first offset is ``first``. Raises LogError if that cannot be
        made."""
        fault = FileFault(self.path, self.file_base, first, found.text, not found.whole)
        try:
            if self._folder != identity_of(self._log):
                raise self.refuse(
                    f"{fault}; {self._log} is another folder than it was. Put the right one back "
                    "and start again"
                )
            self.close()
            if first == self.file_base or not is_readable_segment(self.path, self._head_size):
                set_aside(self.path)
            self._name_file(first)
            self.create()
        except OSError as error:
            raise self.refuse(
                f"{fault}; no new segment at offset {first}: {error.strerror or error}. Offsets "
                f"from there on are not recorded. Check that {self._log} is there and its disk has "
                "room, then start again"
            ) from error
        self._on_fault(fault)

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
            if self._fd >= 0 and os.fstat(self._fd).st_size > self.size:
                os.ftruncate(self._fd, self.size)
        except OSError as cut_error:
            message += f" (the torn end stays: {cut_error.strerror}; recovery ignores it)"
        return self.refuse(message)

    def refuse(self, message: str) -> LogError:
        """From now on every append and commit raises this."""
        self._failure = message
        return LogError(message)

    def close(self) -> None:
        """Let go of the file. Does not commit."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
