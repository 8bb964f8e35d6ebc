"""Bringing a log that was left in the middle of things back in order.

On the next start, by itself: half-made files go, and every left-over active segment is sealed with
all events whose CRC holds, synced or not. A torn end is what a crash leaves and is cut off without
asking: nothing in it was ever called recorded. Rot is not: the writer refuses to start and names
`mapfold log recover`, which a person must run.

An active file is deleted only after the sealed one that replaces it is synced under its name.
"""

from dataclasses import dataclass
from pathlib import Path

from eventsrc.errors import LogDamaged

from ._active_file import ActiveFile
from ._naming import ACTIVE, SegmentPath, leftovers, list_segments, segment_path
from ._scan import Scan, scan_active
from ._seal import NO_PREVIOUS, SegmentPlan, file_sha256, seal
from ._sealed_file import SealedFile
from .fsync import sync_directory, unlink_quietly


@dataclass(slots=True)
class Restart:
    """Where a writer goes on, and what its predecessor left undone.

    ``torn_bytes`` and ``torn_events`` were being written when it died and were never synced.
    """

    log_id: str | None = None
    next_offset: int = 0
    previous_sha256: str = NO_PREVIOUS
    recovered_segments: int = 0
    recovered_events: int = 0
    torn_bytes: int = 0
    torn_events: int = 0


def restart(log: Path) -> Restart:
    """Seal what is left over. The caller holds the writer lock."""
    for path in leftovers(log):
        unlink_quietly(path)
    segments = list_segments(log)
    state = Restart()
    for index, segment in enumerate(segments):
        reach = segments[index + 1].base if index + 1 < len(segments) else segment.base
        if segment.sealed:
            unlink_quietly(segment_path(log, segment.base, ACTIVE))
        else:
            _seal_leftover(log, segment, reach, state)
    _read_end(log, state)
    return state


def _seal_leftover(log: Path, segment: SegmentPath, reach: int, state: Restart) -> None:
    """``reach`` is the base of the next segment: this one was whole before that was begun."""
    scan = scan_active(segment.path, segment.base)
    scan.gap_up_to(reach)
    _refuse_rot(segment.path, scan)
    state.torn_bytes += scan.lost_bytes
    state.torn_events += scan.torn_events
    state.log_id = state.log_id or scan.log_id
    if scan.chunks:
        _seal_active(log, segment, scan)
        state.recovered_segments += 1
        state.recovered_events += scan.next_offset - segment.base
    segment.path.unlink()
    sync_directory(log)


def _refuse_rot(path: Path, scan: Scan) -> None:
    if scan.gaps:
        first, last = scan.gaps[0]
        raise LogDamaged(
            f"{path}: offsets {first} to {last} were recorded and cannot be read any more; "
            f"run `mapfold log recover {path.parent}` to keep the rest"
        )


def _seal_active(log: Path, segment: SegmentPath, scan: Scan) -> None:
    before = [s for s in list_segments(log) if s.base < segment.base]
    previous = file_sha256(before[-1].path) if before else NO_PREVIOUS
    file = ActiveFile(segment.path, segment.base)
    plan = SegmentPlan(log, file.log_id, segment.base, previous)
    seal(plan, (file.read_chunk(chunk) for chunk in scan.chunks))


def _read_end(log: Path, state: Restart) -> None:
    """Fill in where the log ends, now that every segment is sealed."""
    segments = list_segments(log)
    if not segments:
        return
    last = segments[-1]
    file = SealedFile(last.path, last.base)
    state.log_id = file.log_id
    state.next_offset = file.next_offset
    state.previous_sha256 = file_sha256(last.path)
