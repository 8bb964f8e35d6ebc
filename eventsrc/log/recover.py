"""Recovery of a damaged log (`mapfold log recover`): keep every readable event, report the rest.

Nothing is changed in place. A damaged segment is rewritten, synced and renamed; an original in
which something recorded is damaged is kept as ``….damaged`` for a person to look at. A torn end
that was never synced is cut off, as on any restart. Lost offsets become loss events (see
`rebuild_segment`). A rewritten segment also holds the hash that its successor has of the original,
so that the hash chain holds. A saved gap ledger is deleted first: it may count lost events.
"""

import uuid
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from eventsrc.base.errors import LogDamaged, LogError, NotALog
from eventsrc.base.machine import system_clock
from eventsrc.base.progress import reported
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from .active_segment import ActiveSegment
from .archive_place import refuse_away
from .durable_files import GROUP_COMMIT, delete_durably, keep_copy, sync_directory, unlink_quietly
from .lock import WriterLock
from .mcap_records import MESSAGE_HEAD
from .redact import Pending
from .rewrite_segments import (
    Moved,
    adjacent_times,
    quarantine,
    rebuild_segment,
    rewrite_segments,
    slice_scan,
)
from .scan import scan_active, scan_sealed
from .seal import NO_PREVIOUS, REPLACES, SegmentPlan, file_sha256
from .sealed_end import SealedEnd, sealed_end, sealed_end_of, segments_left, write_sealed_end
from .sealed_segment import check_sealed
from .segment import Scan

DEFAULT_MAX_LOSSES: Final = 100_000
"""Loss events added without ``--yes``, besides those that the damaged bytes can have held."""
_MAX_SEGMENT_EVENTS: Final = 1 << 31
_BLOCK_BYTES: Final = 512
"""Size of a block in `st_blocks`, on every file system."""


class TooManyLosses(LogError):
    """Recovery would add more loss events than it was allowed to."""


@dataclass(frozen=True, slots=True)
class SegmentRecovery:
    """A segment that was rewritten. ``gaps`` are the first and last offsets of recorded events that
    are lost; ``torn_events`` were never synced; ``kept_copy`` names the damaged original."""

    name: str
    kept_events: int
    kept_bytes: int
    lost_events: int
    lost_bytes: int
    torn_events: int
    gaps: tuple[tuple[Offset, Offset], ...]
    kept_copy: str | None


@dataclass(frozen=True, slots=True)
class RecoveryReport:
    """``segments`` were rewritten, ``moved`` were renamed. If both are empty, there was nothing to
    recover."""

    path: Path
    events: int
    segments: tuple[SegmentRecovery, ...]
    moved: tuple[Moved, ...]

    @property
    def findings(self) -> bool:
        """Whether any bytes or events were lost, recorded or not, or any file was renamed."""
        lost = any(s.lost_events or s.torn_events or s.lost_bytes for s in self.segments)
        return lost or bool(self.moved)


def recover_log(log: Path, *, max_losses: int = DEFAULT_MAX_LOSSES) -> RecoveryReport:
    """Recover a log.

    Raises LogNotFound, NotALog or LogBusy; LogDamaged when another program made a segment;
    TooManyLosses when more than ``max_losses`` events would be added that the damaged bytes cannot
    have held; LogError when the disk fails.
    """
    if not (log.is_dir() and names.half_renamed(log)):
        refuse_away(log, segments_left(log))
    try:
        with WriterLock(log, system_clock):
            return _Recovery(log, max_losses).run()
    except OSError as error:
        raise LogError(
            f"{error.filename or log}: {error.strerror or error}; no event that could be read was "
            "removed. Free space or fix the disk, then recover again"
        ) from error


class _Recovery:
    def __init__(self, log: Path, max_losses: int) -> None:
        self._log = log
        self._losses_left = max_losses
        self._overlapping: list[names.SegmentPath] = []
        """Segments set aside because they overlap others, in the order of their bases."""
        self._recovered: list[SegmentRecovery] = []
        self._next_offset = FIRST_OFFSET
        self._previous: names.SegmentPath | None = None

    def run(self) -> RecoveryReport:
        if (redaction := Pending.of(self._log)) is not None:
            redaction.replace_segments()
        for path in names.leftovers(self._log):
            unlink_quietly(path)
        noted = sealed_end(self._log)
        log_id, self._moved = rewrite_segments(self._log, None if noted is None else noted.log_id)
        if self._moved:
            delete_durably(self._log / names.LEDGER)
        self._log_id = log_id or (uuid.uuid4().hex if noted is None else noted.log_id)
        self._sealed_end = sealed_end_of(self._log, self._log_id)
        segments = names.list_segments(self._log)
        watched = reported(segments, "recovering", len(segments), "segments")
        for index, segment in enumerate(watched):
            following = segments[index + 1] if index + 1 < len(segments) else None
            if segment.base > self._next_offset:
                self._fill_from_overlapping(segment)
            if segment.base > self._next_offset:
                self._replace_missing(segment.base, segment)
            if segment.base < self._next_offset:
                self._set_aside_overlapping(segment)
            else:
                self._recover_segment(segment, following)
        self._fill_from_overlapping(None)
        if self._sealed_end is not None and self._sealed_end.following > self._next_offset:
            self._replace_missing(self._sealed_end.following, None)
        self._note_sealed_end()
        return RecoveryReport(
            self._log, self._next_offset, tuple(self._recovered), tuple(self._moved)
        )

    def _replace_missing(self, end: Offset, following: names.SegmentPath | None) -> None:
        """Put a segment of losses in place of a missing one."""
        scan = Scan(self._next_offset, None, next_offset=self._next_offset)
        scan.add_gap_until(end)
        self._rewrite(None, scan, following)

    def _note_sealed_end(self) -> None:
        """Write how far the log is sealed, if the file says anything else."""
        if self._previous is None:
            delete_durably(self._log / names.SEALED_END)
            return
        end = SealedEnd(self._log_id, self._previous.base, self._next_offset)
        if sealed_end(self._log) != end:
            write_sealed_end(self._log, end)

    def _reach(
        self, segment: names.SegmentPath, following: names.SegmentPath | None
    ) -> Offset | None:
        """Where a segment ends at least, by the next one or by `sealed_end`; None if unknown."""
        if self._overlapping:
            return None
        if following is not None:
            return following.base
        return None if self._sealed_end is None else self._sealed_end.reach(segment.base)

    def _recover_segment(
        self, segment: names.SegmentPath, following: names.SegmentPath | None
    ) -> None:
        reach = self._reach(segment, following)
        if segment.sealed:
            unlink_quietly(names.segment_path(self._log, segment.base, names.ACTIVE))
            scan = _scan(segment, reach)
            good = not (scan.gaps or scan.index_fault)
            if good and check_sealed(segment.path).fault is None:
                self._next_offset = scan.next_offset
                self._previous = segment
                return
        else:
            scan = _scan(segment, reach)
            if segment.base == 0 and scan.log_id and scan == Scan(FIRST_OFFSET, scan.log_id):
                return  # an empty and undamaged log
        self._rewrite(segment, scan, following)

    def _set_aside_overlapping(self, segment: names.SegmentPath) -> None:
        """Set aside a segment that begins before the previous one ends, from a backup perhaps."""
        reason = f"it begins before offset {self._next_offset}, where the segment before it ends"
        delete_durably(self._log / names.LEDGER)
        moved = quarantine(segment.path, names.DUPLICATE, reason)
        self._moved.append(moved)
        self._overlapping.append(replace(segment, path=self._log / moved.now))

    def _fill_from_overlapping(self, following: names.SegmentPath | None) -> None:
        """Add missing events from the segments that were set aside."""
        for overlapping in self._overlapping:
            scan = _scan(overlapping, None)
            if scan.next_offset > self._next_offset:
                end = scan.next_offset if following is None else following.base
                rest = slice_scan(overlapping.path, scan, self._next_offset, end)
                if rest.chunks:
                    self._rewrite(None, rest, following)

    def _check_losses(
        self, segment: names.SegmentPath | None, scan: Scan, following: names.SegmentPath | None
    ) -> None:
        """Raise TooManyLosses if too many losses would be added: a single damaged number can
        declare any count."""
        losses = sum(last - first + 1 for first, last in scan.gaps)
        self._losses_left -= max(0, losses - _damaged_bytes(segment, scan) // MESSAGE_HEAD)
        if self._losses_left >= 0 and losses <= _MAX_SEGMENT_EVENTS:
            return
        evidence = (
            f"{following.path.name} begins there"
            if following
            else f"according to the offsets in the file and {names.SEALED_END}"
        )
        next_step = (
            f"If that is right, run `{advised('log', 'recover', self._log, '--yes')}`; else move "
            "the file that is wrong out of the log"
            if losses <= _MAX_SEGMENT_EVENTS
            else "No log is that long: move the file that is wrong out of the log"
        )
        raise TooManyLosses(
            f"{self._log}: {losses:,} events from offset {scan.gaps[0][0]} to {scan.gaps[-1][1]} "
            f"seem to be lost ({evidence}), more than the damaged bytes can have held, and each "
            f"would get a loss event. {next_step}{self._moved_so_far()}"
        )

    def _moved_so_far(self) -> str:
        done = ", ".join(f"{moved.name} is now {moved.now}" for moved in self._moved)
        return f" (done before: {done})" if done else ""

    def _rewrite(
        self, segment: names.SegmentPath | None, scan: Scan, following: names.SegmentPath | None
    ) -> None:
        self._check_losses(segment, scan, following)
        delete_durably(self._log / names.LEDGER)
        copy = self._keep_copy(segment, scan)
        if scan.next_offset > scan.base:
            plan = SegmentPlan(
                self._log,
                self._log_id,
                scan.base,
                file_sha256(self._previous.path) if self._previous else NO_PREVIOUS,
                scan.next_offset,
                {**_origin(segment), **_replaced_hash(following)},
            )
            times = adjacent_times(self._previous, following)
            rebuild_segment(plan, segment.path if segment else None, scan, times)
            self._previous = self._sealed(scan.base)
        if segment is not None:
            self._remove_original(segment, scan)
        self._next_offset = scan.next_offset
        self._recovered.append(_segment_report(segment, scan, copy))

    def _remove_original(self, segment: names.SegmentPath, scan: Scan) -> None:
        """Delete the original unless it was replaced under its name. A log without events gets an
        empty segment, which carries its id."""
        replaced = segment.sealed and scan.next_offset > scan.base
        if scan.next_offset == 0:
            empty = ActiveSegment(self._log, self._log_id, FIRST_OFFSET, GROUP_COMMIT)
            empty.create()
            empty.close()
            replaced = not segment.sealed
        if not replaced:
            segment.path.unlink()
            sync_directory(self._log)

    def _sealed(self, base: Offset) -> names.SegmentPath:
        return names.SegmentPath(names.segment_path(self._log, base, names.SEALED), base, True)

    def _keep_copy(self, segment: names.SegmentPath | None, scan: Scan) -> str | None:
        if segment is None or not (segment.sealed or scan.gaps):
            return None
        number = 1
        while True:
            suffix = names.DAMAGED if number == 1 else f"{names.DAMAGED}-{number}"
            copy = segment.path.with_name(segment.path.name + suffix)
            try:
                keep_copy(segment.path, copy)
            except FileExistsError:
                number += 1
            else:
                sync_directory(self._log)
                return copy.name


def _scan(segment: names.SegmentPath, reach: Offset | None) -> Scan:
    """Scan a segment, which ends at ``reach`` if that is known."""
    if segment.sealed:
        return scan_sealed(segment.path, segment.base, reach)
    scan = scan_active(segment.path, segment.base)
    scan.add_gap_until(reach or segment.base)
    return scan


def _damaged_bytes(segment: names.SegmentPath | None, scan: Scan) -> int:
    """Damaged bytes that can have held events; the holes of a sparse file cannot."""
    if segment is None:
        return 0
    return min(scan.lost_bytes, segment.path.stat().st_blocks * _BLOCK_BYTES)


def _origin(segment: names.SegmentPath | None) -> dict[str, str]:
    """Metadata with the time when the original was begun, if it can be read."""
    if segment is None:
        return {}
    try:
        return names.origin_notes(names.head_at_any_base(segment.path))
    except (LogDamaged, NotALog):
        return {}


def _replaced_hash(following: names.SegmentPath | None) -> dict[str, str]:
    """Metadata with the hash that the next segment has of the one before it, if readable."""
    if following is None:
        return {}
    try:
        previous = names.head_of(following.path, following.base).get(names.PREVIOUS)
    except (LogDamaged, NotALog):
        return {}
    return {} if previous is None else {REPLACES: previous}


def _segment_report(
    segment: names.SegmentPath | None, scan: Scan, copy: str | None
) -> SegmentRecovery:
    return SegmentRecovery(
        name=segment.path.name if segment else f"{scan.base:020d}{names.SEALED}",
        kept_events=sum(chunk.following - chunk.first for chunk in scan.chunks),
        kept_bytes=sum(chunk.length for chunk in scan.chunks),
        lost_events=sum(last - first + 1 for first, last in scan.gaps),
        lost_bytes=scan.lost_bytes,
        torn_events=scan.torn_events,
        gaps=tuple(scan.gaps),
        kept_copy=copy,
    )
