"""`mapfold log recover`: keep what can be kept of a damaged log, and say what could not.

Nothing is changed in place. Each segment that needs it is written anew beside, synced and renamed;
an original in which anything recorded is damaged is kept as ``….damaged`` for a person to look at.
A torn end that was never synced is cut off, as on any restart. Lost offsets become losses (see
`_rebuild`). A rewritten segment notes the hash that its successor knows its original by, so the
chain can still be followed. A ledger saved beside the log goes first: it may know events that the
log is about to lose.
"""

import uuid
from dataclasses import dataclass
from pathlib import Path

from eventsrc import _ledger_cache  # which reads logs by this package's reader
from eventsrc.clock import Clock, system_clock
from eventsrc.errors import LogDamaged, LogError, NotALog

from ._active import ActiveSegment
from ._check import check_sealed
from ._head import head_of
from ._lock import WriterLock
from ._moment import moment_between
from ._naming import ACTIVE, DAMAGED, SEALED, SegmentPath, leftovers, list_segments, segment_path
from ._rebuild import rebuild
from ._scan import Scan, scan_active
from ._scan_sealed import scan_sealed
from ._seal import NO_PREVIOUS, REPLACES, SegmentPlan, file_sha256
from ._whose import log_id_of
from .fsync import GROUP_COMMIT, keep_copy, sync_directory, unlink_quietly
from .reader import segments_of


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
    gaps: tuple[tuple[int, int], ...]
    kept_copy: str | None


@dataclass(frozen=True, slots=True)
class RecoveryReport:
    """Empty ``segments``: there was nothing to recover."""

    path: Path
    events: int
    segments: tuple[SegmentRecovery, ...]

    @property
    def lost(self) -> bool:
        """Whether anything is gone, recorded or not."""
        return any(s.lost_events or s.torn_events or s.lost_bytes for s in self.segments)


def recover_log(log: Path, *, clock: Clock = system_clock) -> RecoveryReport:
    """Recover a log. Raises LogNotFound, NotALog, LogBusy, LogDamaged when its segments are of two
    logs, or LogError when the disk refuses."""
    segments_of(log)
    try:
        with WriterLock(log, clock):
            return _Recovery(log).run()
    except OSError as error:
        raise LogError(
            f"{log}: {error.strerror or error}; nothing was replaced by less than it held. "
            "Free space or fix the disk, then recover again"
        ) from error


class _Recovery:
    def __init__(self, log: Path) -> None:
        self._log = log
        self._done: list[SegmentRecovery] = []
        self._next = 0
        self._previous: SegmentPath | None = None

    def run(self) -> RecoveryReport:
        for path in leftovers(self._log):
            unlink_quietly(path)
        segments = list_segments(self._log)
        self._log_id = log_id_of(segments) or uuid.uuid4().hex
        for index, segment in enumerate(segments):
            following = segments[index + 1] if index + 1 < len(segments) else None
            if segment.base > self._next:
                self._replace_missing(segment)
            self._visit(segment, following)
        return RecoveryReport(self._log, self._next, tuple(self._done))

    def _replace_missing(self, following: SegmentPath) -> None:
        """A whole segment is gone: its offsets become losses."""
        scan = Scan(self._next, None, next_offset=self._next)
        scan.gap_up_to(following.base)
        self._rewrite(None, scan, following)

    def _visit(self, segment: SegmentPath, following: SegmentPath | None) -> None:
        reach = following.base if following is not None else None
        if segment.sealed:
            unlink_quietly(segment_path(self._log, segment.base, ACTIVE))
            scan = scan_sealed(segment.path, segment.base, reach)
            sound = not scan.gaps and scan.index_fault is None
            if sound and check_sealed(segment.path).fault is None:
                self._next = scan.next_offset
                self._previous = segment
                return
        else:
            scan = scan_active(segment.path, segment.base)
            scan.gap_up_to(reach or segment.base)
            if segment.base == 0 and scan.log_id and scan == Scan(0, scan.log_id):
                return  # an empty log, and whole
        self._rewrite(segment, scan, following)

    def _rewrite(
        self, segment: SegmentPath | None, scan: Scan, following: SegmentPath | None
    ) -> None:
        _ledger_cache.forget(self._log)
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
            empty = ActiveSegment(self._log, self._log_id, 0, GROUP_COMMIT)
            empty.create()
            empty.close()
            replaced = not segment.sealed
        if not replaced:
            segment.path.unlink()
            sync_directory(self._log)

    def _sealed(self, base: int) -> SegmentPath:
        return SegmentPath(segment_path(self._log, base, SEALED), base, True)

    def _keep_copy(self, segment: SegmentPath | None, scan: Scan) -> str | None:
        if segment is None or not (segment.sealed or scan.gaps):
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
