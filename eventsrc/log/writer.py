"""Appending to a log: one writer, dense offsets, group commit, rotation.

An event has an offset when `append` returns and is *recorded* when `durable_offset` has passed it.
A writer belongs to one thread. Every error is final for it: what is synced stays, what waits was
never called recorded, and the next writer goes on behind the last good event.
"""

import contextlib
import errno
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from eventsrc.clock import Clock, system_clock
from eventsrc.envelope import ENVELOPE_VERSION, Offset
from eventsrc.errors import LogError, MapfoldError, NotALog

from .active_segment import ActiveSegment
from .commit_thread import Commits, OverlappedCommits
from .durable_files import GROUP_COMMIT, FsyncPolicy, make_directory_durably, unlink_quietly
from .event import NewEvent
from .file_fault import FileFault
from .format import LOCK, leftovers, list_segments
from .lock import WriterLock
from .mcap_records import MAX_EVENT_BYTES
from .restart import Restart, restart
from .seal_worker import Sealer

ROTATE_BYTES = 64 * 1024 * 1024
ROTATE_EVENTS = 1_000_000
ROTATE_SECONDS = 3600.0
ROTATE_CHANNELS = 4_096
"""A segment keeps the names of its channels in memory and writes them once more when it is sealed,
and MCAP counts no more than 65,535 of them. Whoever invents keys gets more segments."""
_MAX_NS = 2**63


class Sealing(NamedTuple):
    """``waiting`` segments are finished and not sealed yet. ``error`` says why the first of them is
    not, if it was tried; that costs disk and loses nothing."""

    waiting: int
    error: LogError | None


class LogWriter:
    """A context manager; creates the log if there is none, takes its lock, recovers what a
    predecessor left. Raises LogBusy, NotALog, LogDamaged or LogError.

    A segment file that somebody deletes, moves or cuts short under the writer is given up, and
    writing goes on in a new one behind the last recorded offset; `faults` tells at once, and
    `close` raises LogError.

    ``overlap`` is for much at once. A thread beside the caller's then writes and syncs one group
    while the next is taken, so `durable_offset` moves by itself and an error shows with one of the
    next calls (but not under ``always``, which syncs before `append` returns); and segments are
    sealed in a process of their own.
    """

    def __init__(
        self,
        path: Path,
        *,
        fsync: FsyncPolicy = GROUP_COMMIT,
        clock: Clock = system_clock,
        rotate_bytes: int = ROTATE_BYTES,
        rotate_events: int = ROTATE_EVENTS,
        rotate_seconds: float = ROTATE_SECONDS,
        overlap: bool = False,
    ) -> None:
        self.path = path
        self._fsync = fsync
        self._clock = clock
        self._rotate_bytes = rotate_bytes
        self._rotate_events = rotate_events
        self._rotate_ns = int(rotate_seconds * 1e9)
        self._closed = False
        self._faults: list[FileFault] = []
        self._overlap = overlap
        self._commits = OverlappedCommits() if overlap and fsync.max_events > 1 else Commits()
        try:
            self._open()
        except OSError as error:
            place, reason = error.filename or path, error.strerror or error
            raise LogError(f"{place}: {reason}; {_way_out(error)}") from error

    def _open(self) -> None:
        _make_log_directory(self.path)
        self._lock = WriterLock(self.path, self._clock)
        try:
            self.restart: Restart = restart(self.path)
            self.log_id = self.restart.log_id or uuid.uuid4().hex
            self._sealer = Sealer(
                self.path, self.log_id, self.restart.previous_sha256, aside=self._overlap
            )
            self._active = self._ending = self._next_segment(self.restart.next_offset)
            self._active.create()
            for base, following in self.restart.unsealed:
                self._sealer.submit(base, following)
        except BaseException:
            self._lock.release()
            raise

    def _next_segment(self, base: Offset) -> ActiveSegment:
        self._begun = time.monotonic_ns()
        slack = self._commits.slack
        return ActiveSegment(self.path, self.log_id, base, self._fsync, slack, self._take_fault)

    def _take_fault(self, fault: FileFault) -> None:
        if not fault.lost and fault.following > fault.base:
            self._sealer.submit(fault.base, fault.following)
        self._faults.append(fault)

    @property
    def next_offset(self) -> Offset:
        """The offset the next append gets."""
        return self._active.next_offset

    @property
    def durable_offset(self) -> Offset:
        """Every event below it is synced, and visible to readers."""
        ending = self._ending.committed  # all of it is, when it has come to the next one's base
        return ending if ending < self._active.base else self._active.committed

    @property
    def faults(self) -> Sequence[FileFault]:
        """The files that had to be given up so far. A file is among them before `durable_offset`
        passes the first event written behind it."""
        return self._faults

    @property
    def sealing(self) -> Sealing:
        """How far the sealing of finished segments is behind."""
        return Sealing(self._sealer.waiting, self._sealer.error)

    def hurry(self, on: bool) -> None:
        """Say whether more comes than can be taken. Sealing then waits, within bounds, for it takes
        a processor and a disk that recording needs."""
        self._sealer.hurry(on)

    def now_ns(self) -> int:
        """The writer's clock."""
        return self._clock()

    def append(
        self,
        key: str,
        payload: bytes,
        *,
        stamp_ns: int | None = None,
        logged_ns: int | None = None,
        version: int = ENVELOPE_VERSION,
    ) -> int:
        """Take one event; its offset. Commits when the fsync policy says so.

        ``logged_ns`` is now by the writer's clock unless given; ``stamp_ns`` is the same unless
        given; both are int nanoseconds from 0 to 2^63 - 1.
        """
        logged = self._clock() if logged_ns is None else logged_ns
        stamp = logged if stamp_ns is None else stamp_ns
        return self.append_all([NewEvent(key, payload, logged, stamp, version)])

    def append_all(self, events: Sequence[NewEvent]) -> Offset:
        """Take several events in order; the offset of the first. Commits in between as the policy
        says, as `append` of each would. None is taken unless all times and sizes are in bounds."""
        for event in events:
            if len(event.payload) > MAX_EVENT_BYTES:
                raise LogError(
                    f"{self.path}: {len(event.payload):,} bytes under {event.key[:80]!r} are more "
                    f"than the {MAX_EVENT_BYTES:,} that one event may have"
                )
            if not (0 <= event.logged_ns < _MAX_NS and 0 <= event.stamp_ns < _MAX_NS):
                raise LogError(
                    f"times {event.logged_ns} and {event.stamp_ns} are not nanoseconds "
                    "from 0 to 2^63 - 1"
                )
        first = self.next_offset
        taken = 0
        while taken < len(events):
            taken += self._active.take(events, taken)
            self.commit_if_due()
        return first

    def commit_if_due(self) -> bool:
        """Group commit and rotation by time; True when a commit was made or begun."""
        begun = self._active.due() and self._commits.begin(self._active)
        if self._full():
            self._rotate()
        return begun

    def sync(self) -> Offset:
        """Commit everything appended; the durable offset, which is then `next_offset`."""
        self._commits.finish(self._active)
        return self.durable_offset

    def _full(self) -> bool:
        active = self._active
        events = active.committed - active.file_base
        return events > 0 and (
            active.size >= self._rotate_bytes
            or active.channels >= ROTATE_CHANNELS
            or events >= self._rotate_events
            or time.monotonic_ns() - self._begun >= self._rotate_ns
        )

    def _rotate(self) -> None:
        ending, following = self._active, self._next_segment(self._active.next_offset)
        self._ending, self._active = ending, following  # first: if this fails, both refuse
        self._commits.rotate(ending, following, lambda: self._submit(ending))

    def _submit(self, finished: ActiveSegment, *, last: bool = False) -> None:
        self._sealer.submit(finished.file_base, finished.committed, last=last)

    def close(self) -> None:
        """Commit, seal, let the next writer in. Raises LogError when the last events or the seal
        could not be written, or a file had to be given up; the log is released either way."""
        if self._closed:
            return
        self._closed = True
        try:
            self._commits.settle()
            if self._active.waiting:
                self._commits.finish(self._active)
            self._finish_active()
        finally:
            self._commits.close()
            self._ending.close()
            self._active.close()
            self._sealer.finish()
            self._lock.release()
        if self._faults:
            raise LogError(self._told_of_faults())
        if self._sealer.error is not None:
            raise self._sealer.error

    def _told_of_faults(self) -> str:
        more = f" (and {len(self._faults) - 1} more such files)" if len(self._faults) > 1 else ""
        return (
            f"{self._faults[0]}{more}; what was written from offset {self._faults[-1].following} "
            f"on is recorded. Keep other programs away from {self.path}; `mapfold log verify "
            f"{self.path}` names what cannot be read, `mapfold log recover {self.path}` marks it "
            "as lost"
        )

    def _finish_active(self) -> None:
        """An empty segment stays only where it is all there is: it carries the log's id."""
        if self._active.committed > self._active.file_base:
            self._submit(self._active, last=True)
        elif self._active.file_base > 0:
            unlink_quietly(self._active.path)

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(MapfoldError):  # the first error is the one to tell
            self.close()


def _way_out(error: OSError) -> str:
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "free space on its disk and start again"
    return "check its rights, those of its folder, and its disk"


def _make_log_directory(path: Path) -> None:
    if path.exists() and not path.is_dir():
        raise NotALog(f"{path} is a file; a log is a directory, choose another name")
    make_directory_durably(path)
    if list_segments(path) or (path / LOCK).exists():
        return
    ours = set(leftovers(path))
    others = [p for p in path.iterdir() if p not in ours and not p.name.startswith(".")]
    if others:
        raise NotALog(
            f"{path} is no log: it holds {others[0].name} and no segment; "
            "choose a new or an empty folder"
        )
