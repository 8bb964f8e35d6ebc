"""Reading a log by offset, in order, a chunk at a time.

A reader shows durable events only: of the growing segment, the chunks with a commit mark. It holds
no lock and may read while a writer writes, rotates and seals. Damage stops it with LogDamaged,
after every event before it has been given out; `on_gap` lets it go on and be told what is missing.
"""

from collections import OrderedDict
from collections.abc import Collection, Iterator
from pathlib import Path

from eventsrc.errors import LogDamaged, LogNotFound, NotALog

from ._naming import ACTIVE, SEALED, SegmentPath, list_segments, segment_path
from .event import Event
from .segment import ActiveFile, SealedFile, chunk_events

_OPEN_SEGMENTS = 8

OpenSegment = SealedFile | ActiveFile


class LogReader:
    """A context manager over an existing log. Raises LogNotFound, NotALog or LogDamaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._open: OrderedDict[int, OpenSegment] = OrderedDict()
        self._segments = _segments_of(path)
        self._last = self.open_segment(self._segments[-1])
        self.log_id = self._last.log_id

    @property
    def next_offset(self) -> int:
        """The number of durable events as of opening or the last `refresh`."""
        return self._last.next_offset

    @property
    def segments(self) -> tuple[SegmentPath, ...]:
        """The segments as of opening or the last `refresh`, in offset order."""
        return tuple(self._segments)

    def refresh(self) -> int:
        """Take in what was committed since; the new `next_offset`."""
        while True:
            if isinstance(self._last, ActiveFile):
                self._last.refresh()
            following = self._following()
            if following is None:
                return self.next_offset
            if isinstance(self._last, ActiveFile) and self._last.refresh() > following.base:
                continue
            self._segments.append(following)
            self._last = self.open_segment(following)

    def _following(self) -> SegmentPath | None:
        """The segment that starts where the last one ends, once its writer has begun it."""
        base = self.next_offset
        if base == self._last.base:
            return None
        for suffix, sealed in ((SEALED, True), (ACTIVE, False)):
            path = segment_path(self.path, base, suffix)
            if path.exists():
                return SegmentPath(path, base, sealed)
        return None

    def read(
        self, start: int = 0, end: int | None = None, *, keys: Collection[str] | None = None
    ) -> Iterator[Event]:
        """Events from offset ``start`` to before ``end`` (default: `next_offset` as of now)."""
        stop = self.next_offset if end is None else min(end, self.next_offset)
        at = max(start, 0)
        for index, entry in self._entries_from(at):
            if at >= stop:
                return
            segment = self.open_segment(entry)
            yield from _segment_events(segment, at, stop, keys)
            at = max(at, segment.next_offset)
            self._check_follows(index, segment)

    def _entries_from(self, start: int) -> Iterator[tuple[int, SegmentPath]]:
        first = 0
        for index, entry in enumerate(self._segments):
            if entry.base <= start:
                first = index
        yield from ((i, self._segments[i]) for i in range(first, len(self._segments)))

    def _check_follows(self, index: int, segment: OpenSegment) -> None:
        if index + 1 < len(self._segments):
            following = self._segments[index + 1].base
            if following != segment.next_offset:
                raise LogDamaged(
                    f"{self.path}: offsets {segment.next_offset} to {following - 1} are missing "
                    f"after {segment.path.name}; run `mapfold log verify {self.path}`"
                )

    def open_segment(self, entry: SegmentPath) -> OpenSegment:
        segment = self._open.get(entry.base)
        if segment is None:
            segment = _open_segment(self.path, entry)
            self._open[entry.base] = segment
            if len(self._open) > _OPEN_SEGMENTS:
                self._open.popitem(last=False)
        self._open.move_to_end(entry.base)
        return segment

    def close(self) -> None:
        """Let go of the files; iterators that still run keep theirs."""
        self._open.clear()

    def __enter__(self) -> "LogReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _segments_of(path: Path) -> list[SegmentPath]:
    if not path.exists():
        raise LogNotFound(f"no log at {path}; record or import one, or check the path")
    if not path.is_dir():
        raise NotALog(
            f"{path} is a file; a log is a directory. `mapfold import LOG {path}` reads it in"
        )
    segments = list_segments(path)
    if not segments:
        raise NotALog(f"{path} holds no log segment (….mcap); check the path")
    return segments


def _open_segment(log: Path, entry: SegmentPath) -> OpenSegment:
    """Open it under whichever name it has by now: sealing may have renamed it since."""
    if not entry.sealed:
        try:
            return ActiveFile(entry.path, entry.base)
        except FileNotFoundError:
            pass
    return SealedFile(segment_path(log, entry.base, SEALED), entry.base)


def _segment_events(
    segment: OpenSegment, start: int, end: int, keys: Collection[str] | None
) -> Iterator[Event]:
    wanted = None if keys is None else {c for c, key in segment.keys.items() if key in keys}
    for chunk in segment.chunks:
        if chunk.following <= start:
            continue
        if chunk.first >= end:
            return
        if wanted is None or chunk.channels is None or not wanted.isdisjoint(chunk.channels):
            yield from chunk_events(segment, chunk, start, end, keys)
