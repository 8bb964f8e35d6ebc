"""Clean up a log that its last writer did not finish, when the next writer opens it.

Half-made files are deleted, and every left-over active segment keeps all events whose CRC is right,
synced or not. A torn end, left by a crash, was never recorded and is cut off. Damage elsewhere is
damage to recorded bytes: the writer does not start, and its error names `mapfold log recover`.

Sealing takes up to a second a segment, and a restarted recorder must accept events at once. So a
left-over segment is only *finished* here: its torn end is cut off, and a last chunk without a
commit mark gets one. It is then sealed in the background like any full segment. If one of them
cannot be finished (a mark is damaged, or a sealed segment follows), all are sealed at once.

The last left-over segment is read byte by byte, because a crash may have torn it. Those before it
were complete when it was begun, so their marks are trusted; a recorder killed under load leaves
many. If one is damaged, sealing reports it.

An active file is deleted only after the sealed file that replaces it is synced under its name.
"""

import os
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from . import mcap_records as _mcap
from .archive_place import delete_stand_ins, refuse_away
from .durable_files import sync_directory, sync_file, unlink_quietly, write_all
from .log_identity import common_log_id
from .scan import scan_active
from .seal import NO_PREVIOUS, SegmentPlan, file_sha256, seal
from .sealed_end import SealedEnd, note_sealed, sealed_end_of
from .sealed_segment import SealedFile
from .segment import ActiveFile, Scan


@dataclass(slots=True)
class Restart:
    """Where a writer goes on, and what the last writer left unfinished.

    ``torn_bytes`` and ``torn_events`` were being written when it died and were never recorded.
    """

    log_id: str | None = None
    next_offset: Offset = FIRST_OFFSET
    previous_sha256: str = NO_PREVIOUS
    recovered_segments: int = 0
    recovered_events: int = 0
    torn_bytes: int = 0
    torn_events: int = 0
    unsealed: list[tuple[Offset, Offset]] = field(default_factory=list)
    """Base and next offset of the finished segments to be sealed, in order."""
    empty: names.SegmentPath | None = None
    """The last segment, if it has no events. The next writer replaces it under its name; until then
    it may be the only file that has the log's id."""


@dataclass(frozen=True, slots=True)
class _Leftover:
    segment: names.SegmentPath
    scan: Scan
    marked: int
    """How many of the scan's first chunks have a commit mark."""
    position: int
    """The byte in the file after the last of these."""

    @property
    def finishable(self) -> bool:
        """Whether at most the last chunk lacks its mark."""
        chunks = self.scan.chunks
        if self.marked + 1 < len(chunks):
            return False
        return self.marked == len(chunks) or chunks[-1].position == self.position


def restart(log: Path) -> Restart:
    """Clean up what is left over. The caller holds the writer lock.

    Raises LogDamaged for damage in what a writer needs, for segments of different logs, for a
    segment under the name of another, and for sealed segments that are missing at the end.
    """
    for path in names.leftovers(log):
        unlink_quietly(path)
    for path in names.half_renamed(log):
        raise LogDamaged(
            f"{path}: a recovery was interrupted; run `{advised('log', 'recover', log)}`"
        )
    delete_stand_ins(log)
    segments = names.list_segments(log)
    common_log_id(segments)
    for segment in [s for s in segments if s.sealed][-1:]:
        refuse_away(log, [segment])
        SealedFile(segment.path, segment.base).close()  # before anything is changed
    for segment in segments:
        if segment.sealed:
            unlink_quietly(names.segment_path(log, segment.base, names.ACTIVE))
    state = Restart()
    found = _scan_leftovers(log, segments, state)
    last_sealed = max((s.base for s in segments if s.sealed), default=-1)
    if all(left.finishable and left.segment.base > last_sealed for left in found):
        for left in found:
            _finish(left)
            state.unsealed.append((left.segment.base, left.scan.next_offset))
    else:
        for left in found:
            _seal_now(log, left)
    _read_end(log, state, found)
    if state.empty is not None and state.empty.base != state.next_offset:
        state.empty.path.unlink()  # other segments hold its offset
        sync_directory(log)
    return state


def _scan_leftovers(
    log: Path, segments: list[names.SegmentPath], state: Restart
) -> list[_Leftover]:
    """The left-over segments that have events; those without are deleted, except for the last."""
    found = []
    for index, segment in enumerate(segments):
        if segment.sealed:
            continue
        reach = segments[index + 1].base if index + 1 < len(segments) else None
        left = _scan_leftover(segment, reach)
        state.torn_bytes += left.scan.lost_bytes
        state.torn_events += left.scan.torn_events
        state.log_id = state.log_id or left.scan.log_id
        if left.scan.chunks:
            state.recovered_segments += 1
            state.recovered_events += left.scan.next_offset - segment.base
            found.append(left)
        else:
            if left.scan.log_id is not None:
                # The writer had reached this offset, even if files before it are missing.
                state.next_offset = max(state.next_offset, segment.base)
                if reach is None:
                    state.empty = segment
                    continue
            segment.path.unlink()
            sync_directory(log)
    return found


def _scan_leftover(segment: names.SegmentPath, reach: Offset | None) -> _Leftover:
    """Scan a left-over segment; ``reach`` is the base of the next one, None for the last."""
    finished = None if reach is None else _finished(segment, reach)
    if finished is not None:
        return finished
    _refuse_foreign(segment)
    scan = scan_active(segment.path, segment.base)
    scan.add_gap_until(reach or segment.base)
    _refuse_damage(segment.path, scan)
    if not scan.chunks:
        return _Leftover(segment, scan, 0, 0)
    file = ActiveFile(segment.path, segment.base)
    places = [chunk.position for chunk in file.chunks]
    file.close()
    marked = len(places) if places == [c.position for c in scan.chunks[: len(places)]] else -1
    return _Leftover(segment, scan, marked, file.position)


def _finished(segment: names.SegmentPath, reach: Offset) -> _Leftover | None:
    """A segment whose marks reach the next one; None for one that must be scanned."""
    try:
        file = ActiveFile(segment.path, segment.base)
    except (LogDamaged, NotALog):
        return None
    file.close()
    if file.next_offset != reach:
        return None
    scan = Scan(segment.base, file.log_id, chunks=file.chunks, next_offset=reach)
    return _Leftover(segment, scan, len(file.chunks), file.position)


def _refuse_foreign(segment: names.SegmentPath) -> None:
    """Raise ForeignSegment for a file that another program has put in place of a segment."""
    try:
        names.head_of(segment.path, segment.base)
    except names.ForeignSegment:
        raise
    except (LogDamaged, NotALog):
        return  # a torn head: the scan reads what is there


def _refuse_damage(path: Path, scan: Scan) -> None:
    if scan.gaps:
        first, last = scan.gaps[0]
        raise LogDamaged(
            f"{path}: offsets {first} to {last} were recorded and cannot be read any more; "
            f"run `{advised('log', 'recover', path.parent)}` to keep the rest"
        )


def _finish(left: _Leftover) -> None:
    """Cut off the torn end and write a missing last mark, after syncing its chunk."""
    last = left.scan.chunks[-1]
    fd = os.open(left.segment.path, os.O_RDWR | os.O_APPEND)
    try:
        if left.marked < len(left.scan.chunks):
            os.ftruncate(fd, last.position + last.length)
            sync_file(fd)
            seed = names.mark_seed(names.head_of(left.segment.path, left.segment.base))
            write_all(fd, _mcap.encode_mark(last.first, last.following, seed))
        elif os.fstat(fd).st_size > left.position:
            os.ftruncate(fd, left.position)
        sync_file(fd)
    finally:
        os.close(fd)


def _seal_now(log: Path, left: _Leftover) -> None:
    before = [s for s in names.list_segments(log) if s.base < left.segment.base]
    previous = file_sha256(before[-1].path) if before else NO_PREVIOUS
    file = ActiveFile(left.segment.path, left.segment.base)
    base, end, notes = left.segment.base, left.scan.next_offset, names.origin_notes(file.head)
    plan = SegmentPlan(log, file.log_id, base, previous, end, notes)
    seal(plan, (file.read_chunk(chunk) for chunk in left.scan.chunks))
    note_sealed(log, SealedEnd(file.log_id, base, end))
    left.segment.path.unlink()
    sync_directory(log)


def _read_end(log: Path, state: Restart, found: list[_Leftover]) -> None:
    """Set the log's end, and the hash that the next sealed segment carries."""
    sealed = [segment for segment in names.list_segments(log) if segment.sealed]
    if sealed:
        last = SealedFile(sealed[-1].path, sealed[-1].base)
        state.log_id = last.log_id
        state.next_offset = max(state.next_offset, last.next_offset)
        state.previous_sha256 = file_sha256(sealed[-1].path)
    if state.unsealed:
        state.next_offset = max(state.next_offset, found[-1].scan.next_offset)
    end = sealed_end_of(log, state.log_id)
    if end is not None:
        end.require(log, state.next_offset)
