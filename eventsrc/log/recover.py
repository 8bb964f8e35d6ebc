"""`mapfold log recover`: keep what can be kept of a damaged log, and say what could not.

Nothing is changed in place. Each segment that needs it is written anew beside, synced and renamed;
an original in which anything recorded is damaged is kept as ``….damaged`` for a person to look at.
A torn end that was never synced is cut off, as on any restart. Lost offsets become losses (see
`_rebuild`). A rewritten segment notes the hash that its successor knows its original by, so the
chain can still be followed. A ledger saved beside the log goes first: it may know events that the
log is about to lose.
"""

import uuid
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from eventsrc.clock import Clock, system_clock
from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.errors import LogDamaged, LogError, NotALog

from .active_segment import ActiveSegment
from .arrange import Arrangement, Moved, set_aside
from .durable_files import GROUP_COMMIT, delete_durably, keep_copy, sync_directory, unlink_quietly
from .format import (
    ACTIVE,
    DAMAGED,
    DUPLICATE,
    LEDGER,
    SEALED,
    SegmentPath,
    half_renamed,
    head_of,
    leftovers,
    list_segments,
    segment_path,
)
from .lock import WriterLock
from .mcap_records import MESSAGE_HEAD
from .reader import segments_of
from .rebuild_segment import moment_between, rebuild, trimmed
from .scan import Scan, scan_active
from .scan_sealed import scan_sealed
from .seal import NO_PREVIOUS, REPLACES, SegmentPlan, file_sha256
from .sealed_segment import check_sealed

UNASKED_LOSSES: Final = 100_000
"""So many loss events recovery adds unasked, besides those that the damaged bytes can have held."""
_MOST_IN_A_SEGMENT: Final = 1 << 31
_BLOCK_BYTES: Final = 512
"""What `st_blocks` counts, on every file system."""


class TooManyLosses(LogError):
    """Recovery would add more loss events than it was allowed to."""


@dataclass(frozen=True, slots=True)
class SegmentRecovery:
    """What became of one segment. ``gaps`` are first and last offsets of what was recorded and is
    lost; ``torn_events`` were never synced; ``kept_copy`` names the damaged original."""

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
    """``segments`` were rewritten, ``moved`` have other names now. Both empty: there was nothing to
    recover."""

    path: Path
    events: int
    segments: tuple[SegmentRecovery, ...]
    moved: tuple[Moved, ...]

    @property
    def findings(self) -> bool:
        """Whether anything is gone, recorded or not, or did not belong where it stood."""
        lost = any(s.lost_events or s.torn_events or s.lost_bytes for s in self.segments)
        return lost or bool(self.moved)


def recover_log(
    log: Path, *, most_losses: int = UNASKED_LOSSES, clock: Clock = system_clock
) -> RecoveryReport:
    """Recover a log. Raises LogNotFound, NotALog, LogBusy, LogDamaged when its segments are of two
    logs equally often or one was made by another program, TooManyLosses when more than
    ``most_losses`` events would be added that the damaged bytes cannot have held, or LogError when
    the disk refuses."""
    if not (log.is_dir() and half_renamed(log)):
        segments_of(log)
    try:
        with WriterLock(log, clock):
            return _Recovery(log, most_losses).run()
    except OSError as error:
        raise LogError(
            f"{log}: {error.strerror or error}; nothing was replaced by less than it held. "
            "Free space or fix the disk, then recover again"
        ) from error


class _Recovery:
    def __init__(self, log: Path, most_losses: int) -> None:
        self._log = log
        self._losses_left = most_losses
        self._spare: list[SegmentPath] = []
        """Segments set aside because they overlap others, by base."""
        self._done: list[SegmentRecovery] = []
        self._next = FIRST_OFFSET
        self._previous: SegmentPath | None = None

    def run(self) -> RecoveryReport:
        for path in leftovers(self._log):
            unlink_quietly(path)
        arrangement = Arrangement(self._log)
        arrangement.run()
        self._moved = arrangement.moved
        if self._moved:
            delete_durably(self._log / LEDGER)
        self._log_id = arrangement.log_id or uuid.uuid4().hex
        segments = list_segments(self._log)
        for index, segment in enumerate(segments):
            following = segments[index + 1] if index + 1 < len(segments) else None
            if segment.base > self._next:
                self._use_spares(segment)
            if segment.base > self._next:
                self._replace_missing(segment)
            if segment.base < self._next:
                self._set_aside_overlapping(segment)
            else:
                self._visit(segment, following)
        self._use_spares(None)
        return RecoveryReport(self._log, self._next, tuple(self._done), tuple(self._moved))

    def _replace_missing(self, following: SegmentPath) -> None:
        """A whole segment is gone: its offsets become losses."""
        scan = Scan(self._next, None, next_offset=self._next)
        scan.gap_up_to(following.base)
        self._rewrite(None, scan, following)

    def _visit(self, segment: SegmentPath, following: SegmentPath | None) -> None:
        reach = following.base if following is not None and not self._spare else None
        if segment.sealed:
            unlink_quietly(segment_path(self._log, segment.base, ACTIVE))
            scan = _scan(segment, reach)
            good = not (scan.gaps or scan.rewritten or scan.index_fault)
            if good and check_sealed(segment.path).fault is None:
                self._next = scan.next_offset
                self._previous = segment
                return
        else:
            scan = _scan(segment, reach)
            if segment.base == 0 and scan.log_id and scan == Scan(FIRST_OFFSET, scan.log_id):
                return  # an empty log, and whole
        self._rewrite(segment, scan, following)

    def _set_aside_overlapping(self, segment: SegmentPath) -> None:
        """A segment that begins before the one in front of it ends, out of a backup for example."""
        reason = f"it begins before offset {self._next}, where the segment before it ends"
        delete_durably(self._log / LEDGER)
        moved = set_aside(segment.path, DUPLICATE, reason)
        self._moved.append(moved)
        self._spare.append(replace(segment, path=self._log / moved.now))

    def _use_spares(self, following: SegmentPath | None) -> None:
        """Take from overlapping segments what would be missing otherwise."""
        for spare in self._spare:
            scan = _scan(spare, None)
            if scan.next_offset > self._next:
                end = scan.next_offset if following is None else following.base
                rest = trimmed(spare.path, scan, self._next, end)
                if rest.chunks:
                    self._rewrite(None, rest, following)

    def _ask(self, segment: SegmentPath | None, scan: Scan, following: SegmentPath | None) -> None:
        """Raise TooManyLosses rather than add losses without end at the word of one number."""
        losses = sum(last - first + 1 for first, last in scan.gaps)
        self._losses_left -= max(0, losses - _damaged_bytes(segment, scan) // MESSAGE_HEAD)
        if self._losses_left >= 0 and losses <= _MOST_IN_A_SEGMENT:
            return
        said = f"{following.path.name} begins there" if following else "its end says so"
        way_out = (
            f"If that is right, run `mapfold log recover {self._log} --yes`; else move the file "
            "that is wrong out of the log"
            if losses <= _MOST_IN_A_SEGMENT
            else "No log is that long: move the file that is wrong out of the log"
        )
        raise TooManyLosses(
            f"{self._log}: {losses:,} events from offset {scan.gaps[0][0]} to {scan.gaps[-1][1]} "
            f"seem to be lost ({said}), more than the damaged bytes can have held, and each would "
            f"get a loss event. {way_out}{self._moved_so_far()}"
        )

    def _moved_so_far(self) -> str:
        names = ", ".join(f"{moved.name} is now {moved.now}" for moved in self._moved)
        return f" (done before: {names})" if names else ""

    def _rewrite(
        self, segment: SegmentPath | None, scan: Scan, following: SegmentPath | None
    ) -> None:
        self._ask(segment, scan, following)
        delete_durably(self._log / LEDGER)
        copy = self._keep_copy(segment, scan)
        if scan.next_offset > scan.base:
            plan = SegmentPlan(
                self._log,
                self._log_id,
                scan.base,
                file_sha256(self._previous.path) if self._previous else NO_PREVIOUS,
                scan.next_offset,
                _replaces(following),
            )
            nearby = moment_between(self._previous, following)
            rebuild(plan, segment.path if segment else None, scan, nearby)
            self._previous = self._sealed(scan.base)
        if segment is not None:
            self._remove_original(segment, scan)
        self._next = scan.next_offset
        self._done.append(_told(segment, scan, copy))

    def _remove_original(self, segment: SegmentPath, scan: Scan) -> None:
        """Unless what takes its place has its name. A log without any event still has a segment,
        for that carries its id."""
        replaced = segment.sealed and scan.next_offset > scan.base
        if scan.next_offset == 0:
            empty = ActiveSegment(self._log, self._log_id, FIRST_OFFSET, GROUP_COMMIT)
            empty.create()
            empty.close()
            replaced = not segment.sealed
        if not replaced:
            segment.path.unlink()
            sync_directory(self._log)

    def _sealed(self, base: Offset) -> SegmentPath:
        return SegmentPath(segment_path(self._log, base, SEALED), base, True)

    def _keep_copy(self, segment: SegmentPath | None, scan: Scan) -> str | None:
        if segment is None or not (segment.sealed or scan.gaps or scan.rewritten):
            return None
        number = 1
        while True:
            suffix = DAMAGED if number == 1 else f"{DAMAGED}-{number}"
            copy = segment.path.with_name(segment.path.name + suffix)
            try:
                keep_copy(segment.path, copy)
            except FileExistsError:
                number += 1
            else:
                sync_directory(self._log)
                return copy.name


def _scan(segment: SegmentPath, reach: Offset | None) -> Scan:
    """Look at a segment, which ends at ``reach`` if that is known."""
    if segment.sealed:
        return scan_sealed(segment.path, segment.base, reach)
    scan = scan_active(segment.path, segment.base, reach)
    scan.gap_up_to(reach or segment.base)
    return scan


def _damaged_bytes(segment: SegmentPath | None, scan: Scan) -> int:
    """How many bytes are damaged that can have held events; the holes of a sparse file cannot."""
    if segment is None:
        return 0
    return min(scan.lost_bytes, segment.path.stat().st_blocks * _BLOCK_BYTES)


def _replaces(following: SegmentPath | None) -> dict[str, str]:
    """A note of the hash by which the next segment knows the one before it."""
    if following is None:
        return {}
    try:
        claim = head_of(following.path, following.base).get("previous_sha256")
    except (LogDamaged, NotALog):
        return {}
    return {} if claim is None else {REPLACES: claim}


def _told(segment: SegmentPath | None, scan: Scan, copy: str | None) -> SegmentRecovery:
    return SegmentRecovery(
        name=segment.path.name if segment else f"{scan.base:020d}{SEALED}",
        kept_events=sum(chunk.following - chunk.first for chunk in scan.chunks),
        kept_bytes=sum(chunk.length for chunk in scan.chunks),
        lost_events=sum(last - first + 1 for first, last in scan.gaps),
        lost_bytes=scan.lost_bytes,
        torn_events=scan.torn_events,
        gaps=tuple(scan.gaps),
        kept_copy=copy,
    )
