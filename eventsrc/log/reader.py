"""Read the events of a log by offset, in order, one chunk at a time.

A reader yields durable events only: of the growing segment, the chunks with a commit mark. It takes
no lock and can read while a writer writes, rotates and seals. At damage it yields every event
before it and raises LogDamaged; with ``on_gap`` it reports what is missing and continues. A log
whose last segment cannot be opened is read up to there, and raises when its end is asked for.

`follow` polls the commit marks of the file: while nothing comes, one `pread` of some 80 bytes and
five `stat` for the next segment every 5 ms, at one to two percent of a core. A chunk damaged before
it was read looks like one that is being written, so it checks once a second whether events follow.
"""

import contextlib
import sys
import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Collection, Generator, Iterator
from pathlib import Path
from typing import NamedTuple

from eventsrc.base.errors import LogDamaged, LogError, LogNotFound, NotALog
from eventsrc.base.progress import report_progress
from eventsrc.base.text import advised, counted
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from .event import Event
from .format import ACTIVE, SEALED, SegmentPath, list_growing, segment_path
from .log_identity import mixed_logs_message
from .sealed_end import SealedEnd, sealed_end, sealed_end_of, segments_of
from .sealed_segment import SealedFile, open_sealed
from .segment import ActiveFile, Unreadable, chunk_events

_OPEN_SEGMENTS = 8
_NO_END = Offset(sys.maxsize)
_READING = "reading the log"

OpenSegment = SealedFile | ActiveFile
OnGap = Callable[[Unreadable], None]


class _Found(NamedTuple):
    """The segments of a log up to the last that can be opened, and that one, open."""

    segments: tuple[SegmentPath, ...]
    last: OpenSegment


class _UnreadableEnd(NamedTuple):
    """Why the end of a log cannot be read, and the last offset that it is known to have."""

    error: LogError
    last: Offset


class LogReader:
    """A context manager over an existing log. Raises LogNotFound, NotALog, and LogDamaged if none
    of its segments can be opened.

    Several threads may use it at once, each with iterators of its own.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.RLock()
        self._open: OrderedDict[int, OpenSegment] = OrderedDict()
        end = sealed_end(path)  # before the folder is listed: a writer may be active
        self._found, self._unreadable_end = _open_last(path, segments_of(path), end)
        self.log_id = self._last.log_id
        """From its last segment; reading stops at a segment with another id."""

    def __repr__(self) -> str:
        return f"<LogReader {self.path}: {counted(self.readable_end, 'event')}>"

    @property
    def _last(self) -> OpenSegment:
        return self._found.last

    @property
    def next_offset(self) -> Offset:
        """The number of durable events as of opening or the last `refresh`. Raises LogDamaged or
        NotALog if the last segment cannot be read, or is not there."""
        self._require_end()
        return self.readable_end

    @property
    def readable_end(self) -> Offset:
        """`next_offset`; where that raises, the offset from which on nothing can be read."""
        return self._last.next_offset

    def end_for(self, until: Offset | None) -> Offset:
        """``until``, but at most `next_offset`, which it is for None. Raises as `next_offset` if
        that is behind `readable_end`."""
        if until is not None and until <= self.readable_end:
            return until
        return self.next_offset

    def _require_end(self) -> None:
        if self._unreadable_end is not None:
            raise self._unreadable_end.error

    @property
    def segments(self) -> tuple[SegmentPath, ...]:
        """The segments before `readable_end` as of opening or the last `refresh`, in offset
        order."""
        return self._found.segments

    def refresh(self) -> Offset:
        """Find the commits since the last call; return the new `next_offset`, or raise as that."""
        with self._lock:
            return self._refresh()

    def _refresh(self) -> Offset:
        self._require_end()
        while True:
            if isinstance(self._last, ActiveFile):
                self._last.refresh()
            following = self._following()
            if following is not None:
                last = self._open_checked(following)
                self._keep_open(self._last)
                self._found = _Found((*self.segments, following), last)
            elif isinstance(self._last, ActiveFile) and self._last.was_replaced():
                self._reopen_last()
            else:
                return self.next_offset

    def check_end(self) -> None:
        """Raise LogDamaged if recorded events behind `readable_end` cannot be read, and LogNotFound
        if the log was deleted."""
        if not self.path.exists():
            raise LogNotFound(f"the log at {self.path} is gone; check the path")
        report = _raise_at_gap(self.path)
        self._report_damaged_end(FIRST_OFFSET, report)
        end = sealed_end_of(self.path, self.log_id)
        segments = list_growing(self.path)
        known = self.refresh()  # after listing the folder: a writer may be active
        if end is not None:
            end.require(self.path, known)
        for newest in segments[-1:]:
            if newest.base > known:
                report(
                    Unreadable(known, Offset(newest.base - 1), f"missing before {newest.path.name}")
                )

    def _reopen_last(self) -> None:
        """Open the last segment again: a restarted writer has sealed it, perhaps with events that
        had no commit mark yet, or has replaced an empty one."""
        self._found = self._found._replace(last=self._open_checked(self.segments[-1]))

    def _following(self) -> SegmentPath | None:
        """The segment that starts where the last one ends, once its writer has begun it."""
        base = self.next_offset
        if base == self._last.base:
            return None
        # The third test finds a segment that was sealed between the first two.
        for suffix, sealed in ((SEALED, True), (ACTIVE, False), (SEALED, True)):
            path = segment_path(self.path, base, suffix)
            if path.exists():
                return SegmentPath(path, base, sealed)
        return None

    def read(
        self,
        start: Offset = FIRST_OFFSET,
        end: Offset | None = None,
        *,
        keys: Collection[str] | None = None,
        on_gap: OnGap | None = None,
    ) -> Iterator[Event]:
        """Events from offset ``start`` to before ``end`` (default: all, as of now).

        Raises LogDamaged where events cannot be read; with ``on_gap`` calls that instead and
        continues behind the gap.
        """
        known = self.readable_end
        stop = known if end is None else min(end, known)
        report = on_gap or _raise_at_gap(self.path)
        at = max(start, FIRST_OFFSET)
        try:
            for entry, following in self._entries_from(at):
                if at < min(entry.base, stop):  # the log's first segment is gone
                    last = Offset(min(entry.base, stop) - 1)
                    report(Unreadable(at, last, f"missing before {entry.path.name}"))
                    at = entry.base
                if at >= stop:
                    break
                segment_end = min(stop, following)
                at = yield from self._read_segment(entry, at, segment_end, keys, report)
                if at < segment_end:
                    gap_end = Offset(segment_end - 1)
                    report(Unreadable(at, gap_end, f"missing after {entry.path.name}"))
                    at = segment_end
        finally:
            report_progress(_READING, max(stop, 1), max(stop, 1))
        if end is None or end > known:
            if on_gap is None:
                self._require_end()
            self._report_damaged_end(start, report)

    def _report_damaged_end(self, start: Offset, report: OnGap) -> None:
        """Report recorded events at the end of the log that cannot be read any more."""
        if self._unreadable_end is not None:
            first = max(start, self.readable_end)
            report(
                Unreadable(
                    first, max(first, self._unreadable_end.last), str(self._unreadable_end.error)
                )
            )
            return
        with self._lock:  # it reads commits that were added meanwhile
            gap = self._last.damaged_end() if isinstance(self._last, ActiveFile) else None
        if gap is not None and gap.last >= start:
            report(gap)

    def _entries_from(self, start: Offset) -> Iterator[tuple[SegmentPath, Offset]]:
        """Each segment from the one that holds ``start``, with the base of the next one."""
        segments = self.segments
        first = bisect_right(segments, start, key=lambda entry: entry.base) - 1
        for index in range(max(first, 0), len(segments)):
            is_last = index + 1 == len(segments)
            yield segments[index], _NO_END if is_last else segments[index + 1].base

    def stretches(self, start: Offset, end: Offset, size: int) -> Iterator[tuple[Offset, Offset]]:
        """Ranges that make up ``start`` to ``end``, in order, for several readers to share: each is
        of whole chunks of one segment, in the file about ``size`` bytes or one chunk, or of events
        that cannot be read. None is of more than ``size`` / 1024 events, but for one chunk."""
        at = start
        for entry, following in self._entries_from(start):
            segment_end = min(end, following)
            for edge in self._edges(entry, at, size):
                if at < edge < segment_end:
                    yield at, edge
                    at = edge
            if at < segment_end:
                yield at, segment_end
                at = segment_end

    def _edges(self, entry: SegmentPath, start: Offset, size: int) -> Iterator[Offset]:
        """Where to divide a segment; nowhere if it cannot be opened."""
        try:
            segment = self.open_segment(entry)
        except (LogDamaged, NotALog):
            return
        first, length = start, 0
        for chunk in segment.chunks:
            if chunk.following <= start:
                continue
            if length and (length + chunk.length > size or chunk.following - first > size // 1024):
                yield chunk.first
                first, length = chunk.first, 0
            length += chunk.length

    def _read_segment(
        self,
        entry: SegmentPath,
        start: Offset,
        end: Offset,
        keys: Collection[str] | None,
        report: OnGap,
    ) -> Generator[Event, None, Offset]:
        """The events of one segment; returns the offset after the last one yielded or reported."""
        try:
            segment = self.open_segment(entry)
        except (LogDamaged, NotALog) as error:
            report(Unreadable(start, Offset(end - 1), str(error)))
            return end
        wanted = _wanted_channels(segment, keys)
        at = start
        for chunk in segment.chunks:
            if chunk.following <= at:
                continue
            if chunk.first >= end:
                break
            report_progress(_READING, chunk.first, self.readable_end)
            if wanted is None or chunk.channels is None or not wanted.isdisjoint(chunk.channels):
                try:
                    yield from chunk_events(segment, chunk, at, end, keys)
                except LogDamaged as error:
                    last = Offset(min(chunk.following, end) - 1)
                    report(Unreadable(max(chunk.first, at), last, str(error)))
            at = chunk.following
        return at

    def open_segment(self, entry: SegmentPath) -> OpenSegment:
        """One of `segments`, open. The last one is the object that `refresh` updates."""
        with self._lock:
            if entry.base == self._last.base:
                return self._last
            segment = self._open.get(entry.base) or self._open_checked(entry)
            self._keep_open(segment)
            return segment

    def _open_checked(self, entry: SegmentPath) -> OpenSegment:
        segment = _open_segment(self.path, entry)
        if segment.log_id != self.log_id:
            raise LogDamaged(
                mixed_logs_message(entry.path, segment.log_id, self._last.path, self.log_id)
            )
        return segment

    def _keep_open(self, segment: OpenSegment) -> None:
        self._open[segment.base] = segment
        self._open.move_to_end(segment.base)
        if len(self._open) > _OPEN_SEGMENTS:
            self._open.popitem(last=False)

    def close(self) -> None:
        """Close the files; iterators still running keep theirs open."""
        with self._lock:
            self._open.clear()

    def __enter__(self) -> "LogReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _open_last(
    log: Path, segments: list[SegmentPath], sealed: SealedEnd | None
) -> tuple[_Found, _UnreadableEnd | None]:
    """The last segment that can be opened, and what is wrong behind it. Raises if none can be."""
    errors: list[LogError] = []
    for number in range(len(segments), 0, -1):
        try:
            last = _open_segment(log, segments[number - 1])
        except (LogDamaged, NotALog) as error:
            errors.append(error)
            continue
        known = segments[-1].base + 1
        if sealed is not None and sealed.log_id == last.log_id:
            known = max(known, sealed.following)
            missing = sealed.missing(log, last.next_offset)
            if missing is not None:
                errors.append(LogDamaged(missing))
        found = _Found(tuple(segments[:number]), last)
        return found, _UnreadableEnd(errors[0], Offset(known - 1)) if errors else None
    raise errors[0]


def _open_segment(log: Path, entry: SegmentPath) -> OpenSegment:
    """Open a segment under its current name: it may have been sealed since it was listed."""
    try:
        if not entry.sealed:
            with contextlib.suppress(FileNotFoundError):
                return ActiveFile(entry.path, entry.base)
        return open_sealed(log, entry.base)
    except OSError as error:
        reason = error.strerror or str(error)
        raise LogDamaged(f"{entry.path}: {reason}; check the file and the disk") from error


def _raise_at_gap(log: Path) -> OnGap:
    def report(gap: Unreadable) -> None:
        raise LogDamaged(
            f"{log}: offsets {gap.first} to {gap.last} cannot be read: {gap.reason}; "
            f"run `{advised('log', 'verify', log)}`"
        )

    return report


def _wanted_channels(segment: OpenSegment, keys: Collection[str] | None) -> set[int] | None:
    """The ids of the channels with these ``keys``; None if that is known only from each chunk."""
    if keys is None or not isinstance(segment, SealedFile):
        return None
    return {id_ for id_, channel in segment.channels.items() if channel.topic in keys}


POLL_S = 0.005
_CHECK_EVERY = 200
"""Idle polls between two checks: one second."""


def follow(
    path: Path, start: Offset, *, stop: threading.Event, poll_s: float = POLL_S
) -> Iterator[Event | None]:
    """Follow a log as it grows: events from ``start`` on, each once, across rotations, milliseconds
    after its commit, until ``stop`` is set.

    Yields None after each poll, when every durable event has been yielded, so that the caller can
    finish a batch. Raises LogDamaged where events cannot be read, and LogNotFound when the log is
    gone.
    """
    with LogReader(path) as reader:
        at = start
        idle_polls = 0
        while not stop.is_set():
            end = reader.refresh()
            idle_polls = 0 if at < end else idle_polls + 1
            if idle_polls % _CHECK_EVERY == _CHECK_EVERY - 1:
                reader.check_end()
            for event in reader.read(at, end):
                yield event
                if stop.is_set():
                    return
            at = max(at, end)
            yield None
            stop.wait(poll_s)
