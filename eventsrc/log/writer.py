"""Append events to a log: one writer, dense offsets, group commit, rotation.

An event has an offset when `append` returns and is *recorded* when `durable_offset` has passed it.
At most one commit group is not synced at any time. A writer belongs to one thread. After an error
it accepts no more events: synced events stay, waiting ones were never recorded, and the next writer
continues after the last good event.
"""

import contextlib
import errno
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from eventsrc.base.errors import LogError, MapfoldError, NotALog
from eventsrc.base.machine import Clock, system_clock
from eventsrc.base.text import advised, visible
from eventsrc.envelope.model import ENVELOPE_VERSION, Offset
from eventsrc.envelope.system_events import REDACTION_KEY, is_system_key

from .active_segment import ActiveSegment, SegmentFault
from .durable_files import GROUP_COMMIT, FsyncPolicy, make_directory_durably, unlink_quietly
from .event import MessageFormat, NewEvent
from .format import LOCK, leftovers, list_segments
from .lock import WriterLock
from .mcap_records import MAX_EVENT_BYTES
from .redact import Pending
from .restart import Restart, restart
from .sealer import Sealer

ROTATE_BYTES = 64 * 1024 * 1024
ROTATE_EVENTS = 1_000_000
ROTATE_SECONDS = 3600.0
ROTATE_CHANNELS = 4_096
"""Channels (keys and versions, topics and formats) after which a new segment begins. A segment
keeps its channels in memory and writes them again when it is sealed; MCAP allows 65,535."""
ROTATE_DEFINITION_BYTES = 4 * 1024 * 1024
"""Bytes of channels and schemas after which a new segment begins: a sealed one may have twice as
much."""
MAX_SCHEMA_BYTES = 256 * 1024
MAX_NAME_BYTES = 16 * 1024
"""Limit for the topic, encoding and schema names of a verbatim message, each in UTF-8."""
_MAX_NS = 2**63


class Sealing(NamedTuple):
    """How many finished segments are ``waiting`` to be sealed, and the ``error`` of the first if it
    was tried. Unsealed segments take more disk; nothing is lost."""

    waiting: int
    error: LogError | None


class LogWriter:
    """A context manager: creates the log if there is none, takes its lock, recovers what a killed
    writer left, and goes on with a redaction that was begun. Raises LogBusy, NotALog, LogDamaged or
    LogError.

    A segment file that somebody deletes, moves or cuts short while it is written is given up, and
    writing goes on in a new one behind the last recorded offset: see `faults`; `close` then raises
    LogError. Full segments are sealed in a thread of their own; with ``sealing_process`` in a
    process, which costs its start and lets recording use a whole processor. With ``imported``
    its segments say that their events come from files, so that these may be older than the events
    before.
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
        sealing_process: bool = False,
        imported: bool = False,
    ) -> None:
        self.path = path
        self._imported = imported
        self._fsync = fsync
        self._clock = clock
        self._rotate_bytes = rotate_bytes
        self._rotate_events = rotate_events
        self._rotate_ns = int(rotate_seconds * 1e9)
        self._sealing_process = sealing_process
        self._work: Callable[[], bool] | None = None
        self._work_thread: ThreadPoolExecutor | None = None
        self._closed = False
        self._faults: list[SegmentFault] = []
        try:
            self._open()
        except OSError as error:
            place, reason = error.filename or path, error.strerror or error
            raise LogError(f"{place}: {reason}; {_advice(error)}") from error

    def _open(self) -> None:
        _make_log_directory(self.path)
        self._lock = WriterLock(self.path, self._clock)
        try:
            redaction = Pending.of(self.path)
            if redaction is not None:
                redaction.replace_segments()
            self.restart: Restart = restart(self.path)
            self.log_id = self.restart.log_id or uuid.uuid4().hex
            self._sealer = Sealer(
                self.path,
                self.log_id,
                self.restart.previous_sha256,
                in_process=self._sealing_process,
            )
            self._active = self._new_segment(self.restart.next_offset)
            self._active.create()
            for base, following in self.restart.unsealed:
                self._sealer.submit(base, following)
            if redaction is not None:
                for payload in redaction.missing(self.next_offset):
                    self.append(REDACTION_KEY, payload)
                self.sync()
                redaction.note_recorded()
        except BaseException:
            self._lock.release()
            raise

    def _new_segment(self, base: Offset) -> ActiveSegment:
        self._begun = time.monotonic_ns()
        return ActiveSegment(
            self.path,
            self.log_id,
            base,
            self._fsync,
            self._note_fault,
            self._work_while_syncing,
            self._clock,
            imported=self._imported,
        )

    def work_while_syncing(self, work: Callable[[], bool] | None) -> None:
        """Call ``work`` in another thread, again and again, while a commit waits for the disk and
        until it returns False. It must append nothing, and be short: the commit waits for its end.
        """
        self._work = work

    def _work_while_syncing(self, sync: Callable[[], None]) -> None:
        work = self._work
        if work is None:
            sync()
            return
        if self._work_thread is None:
            self._work_thread = ThreadPoolExecutor(1, thread_name_prefix="log-worker")
        synced = threading.Event()
        working = self._work_thread.submit(_work_until, synced, work)
        try:
            sync()
        finally:
            synced.set()
            working.result()

    def _note_fault(self, fault: SegmentFault) -> None:
        if not fault.lost and fault.following > fault.base:
            self._sealer.submit(fault.base, fault.following)
        self._faults.append(fault)

    @property
    def next_offset(self) -> Offset:
        """The offset the next append gets."""
        return self._active.next_offset

    @property
    def durable_offset(self) -> Offset:
        """Every event before this offset is synced, and visible to readers."""
        return self._active.committed

    @property
    def faults(self) -> Sequence[SegmentFault]:
        """The files given up so far. A file is in the list before `durable_offset` passes the first
        event written behind it."""
        return self._faults

    @property
    def sealing(self) -> Sealing:
        """How far sealing is behind."""
        return Sealing(self._sealer.waiting, self._sealer.error)

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
        form: MessageFormat | None = None,
    ) -> int:
        """Append one event, or with ``form`` a verbatim message on topic ``key``; returns its
        offset. Commits when the fsync policy says so.

        ``logged_ns`` defaults to now by the writer's clock, ``stamp_ns`` to ``logged_ns``; both are
        int nanoseconds from 0 to 2^63 - 1.
        """
        logged = self._clock() if logged_ns is None else logged_ns
        stamp = logged if stamp_ns is None else stamp_ns
        return self.append_all([NewEvent(key, payload, logged, stamp, version, form)])

    def append_all(self, events: Sequence[NewEvent]) -> Offset:
        """Append several events in order; returns the offset of the first. Commits in between as
        `append` of each would. Appends none unless all times and sizes are in bounds."""
        for event in events:
            if len(event.payload) > MAX_EVENT_BYTES:
                raise LogError(
                    f"{self.path}: {len(event.payload):,} bytes under {event.key[:80]!r} are more "
                    f"than the {MAX_EVENT_BYTES:,} that one event may have"
                )
            if event.format is not None:
                _check_format(self.path, event.key, event.format)
            if not (0 <= event.logged_ns < _MAX_NS and 0 <= event.stamp_ns < _MAX_NS):
                raise LogError(
                    f"times {event.logged_ns} and {event.stamp_ns} are not nanoseconds "
                    "from 0 to 2^63 - 1"
                )
        first = self.next_offset
        added = 0
        while added < len(events):
            added += self._active.add(events, added)
            self.commit_if_due()
        return first

    def commit_if_due(self) -> bool:
        """Group commit and rotation by time; True when a commit was made."""
        due = self._active.due()
        if due:
            self._active.commit()
        if self._full():
            self._rotate()
        return due

    def sync(self) -> Offset:
        """Commit everything appended; returns the durable offset, which is then `next_offset`."""
        self._active.commit()
        return self.durable_offset

    def begin_segment(self) -> None:
        """Commit, and begin the next segment unless this one is empty. For an import of events
        older than the ones before: verification then reports no clock that was set back."""
        self.sync()
        if self._active.committed > self._active.base:
            self._rotate()

    def _full(self) -> bool:
        active = self._active
        events = active.committed - active.base
        return events > 0 and (
            active.size >= self._rotate_bytes
            or active.channels >= ROTATE_CHANNELS
            or active.definition_bytes >= ROTATE_DEFINITION_BYTES
            or events >= self._rotate_events
            or time.monotonic_ns() - self._begun >= self._rotate_ns
        )

    def _rotate(self) -> None:
        """Begin the next segment. Raises LogError; the writer then accepts no more events."""
        finished = self._active
        following = self._new_segment(finished.next_offset)
        try:
            finished.finish()
            following.create()
        except OSError as error:
            raise finished.disable(
                f"{self.path}: no new segment at offset {following.base}: "
                f"{error.strerror or error}; every event before it is safe. "
                "Free space or fix the disk, then start again"
            ) from error
        self._active = following
        self._submit(finished)

    def _submit(self, finished: ActiveSegment, *, last: bool = False) -> None:
        self._sealer.submit(finished.base, finished.committed, last=last)

    def close(self) -> None:
        """Commit, seal, release the lock. Raises LogError when the last events or a sealed segment
        could not be written, or a file was given up; the lock is released either way."""
        if self._closed:
            return
        self._closed = True
        try:
            if self._active.waiting:
                self._active.commit()
            self._finish_active()
        finally:
            self._active.close()
            if self._work_thread is not None:
                self._work_thread.shutdown()
            self._sealer.finish()
            self._lock.release()
        if self._faults:
            raise LogError(self._describe_faults())
        if self._sealer.error is not None:
            raise self._sealer.error

    def _describe_faults(self) -> str:
        more = f" (and {len(self._faults) - 1} more such files)" if len(self._faults) > 1 else ""
        return (
            f"{self._faults[0]}{more}; what was written from offset {self._faults[-1].following} "
            f"on is recorded. Keep other programs away from {self.path}; "
            f"`{advised('log', 'verify', self.path)}` names what cannot be read, "
            f"`{advised('log', 'recover', self.path)}` marks it as lost"
        )

    def _finish_active(self) -> None:
        """Submit the last segment. An empty one is deleted unless it is the log's only one, which
        carries the log's id."""
        if self._active.committed > self._active.base:
            self._submit(self._active, last=True)
        elif self._active.base > 0:
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
        with contextlib.suppress(MapfoldError):  # the first error is the one to report
            self.close()


def _check_format(log: Path, topic: str, form: MessageFormat) -> None:
    """Raise LogError for a verbatim message whose names or schema cannot be kept."""
    if is_system_key(topic):
        raise LogError(f"{log}: a message on {visible(topic[:80])}: that key is mapfold's own")
    for text in (topic, form.encoding, form.schema, form.schema_encoding):
        if len(text.encode(errors="replace")) > MAX_NAME_BYTES or not _is_unicode(text):
            raise LogError(
                f"{log}: {visible(repr(text[:80]))} of a message on {visible(repr(topic[:80]))} is "
                f"no name: longer than {MAX_NAME_BYTES:,} bytes, or no Unicode text"
            )
    if len(form.schema_text) > MAX_SCHEMA_BYTES:
        raise LogError(
            f"{log}: the schema {visible(form.schema[:80])} has {len(form.schema_text):,} bytes, "
            f"more than {MAX_SCHEMA_BYTES:,}"
        )
    if not (topic and form.encoding):
        name = visible(repr(topic[:80]))
        raise LogError(f"{log}: a message without topic or encoding, on {name}")
    if form.schema_text and not (form.schema and form.schema_encoding):
        raise LogError(
            f"{log}: a schema without a name or an encoding, of messages on {visible(topic[:80])}"
        )


def _is_unicode(text: str) -> bool:
    return not any("\ud800" <= character <= "\udfff" for character in text)


def _work_until(done: threading.Event, work: Callable[[], bool]) -> None:
    while not done.is_set() and work():
        pass


def _advice(error: OSError) -> str:
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
