"""Names of the files of a log.

    00000000000000000000.mcap          sealed: immutable, compressed, indexed
    00000000000000004711.mcap.active   growing, or left over and not sealed yet
    ….mcap.new / .mcap.sealing         being made; means nothing until renamed, safe to delete
    ….mcap.damaged, .mcap.active.damaged   what `mapfold log recover` replaced, kept for a person
    ….foreign, ….duplicate                 what it set aside: of another log; held by other segments
    ….misnamed                             a segment that it is giving its right name
    lock                               held by the one writer
    .ledger.json                       the gap ledger, folded from the events: a cache

A segment is named by its base, the offset of its first event. While a sealed file takes the place
of its active one, both exist for an instant; the sealed one counts.
"""

import re
from dataclasses import dataclass
from pathlib import Path

SEALED = ".mcap"
ACTIVE = ".mcap.active"
NEW = ".mcap.new"
SEALING = ".mcap.sealing"
DAMAGED = ".damaged"
FOREIGN = ".foreign"
DUPLICATE = ".duplicate"
MISNAMED = ".misnamed"
LOCK = "lock"
LEDGER = ".ledger.json"

_NAME = re.compile(r"(\d{20})(\.mcap|\.mcap\.active)")
_MISNAMED = re.compile(_NAME.pattern + r"\.misnamed(-\d+)?")


@dataclass(frozen=True, slots=True)
class SegmentPath:
    """A segment on disk: its base offset and whether it is sealed."""

    path: Path
    base: int
    sealed: bool


def segment_path(log: Path, base: int, suffix: str) -> Path:
    """Where the segment that starts at offset ``base`` stands."""
    return log / f"{base:020d}{suffix}"


def list_segments(log: Path) -> list[SegmentPath]:
    """The segments of ``log`` in offset order, one for each base."""
    found: dict[int, SegmentPath] = {}
    for segment in segment_files(log):
        if segment.sealed or segment.base not in found:
            found[segment.base] = segment
    return [found[base] for base in sorted(found)]


def segment_files(log: Path) -> list[SegmentPath]:
    """Every file of ``log`` that is named as a segment; two of one base while one is sealed."""
    matches = ((entry, _NAME.fullmatch(entry.name)) for entry in log.iterdir())
    return sorted(
        (SegmentPath(entry, int(m[1]), m[2] == SEALED) for entry, m in matches if m is not None),
        key=lambda segment: segment.path.name,
    )


def half_renamed(log: Path) -> list[Path]:
    """Segments that a recovery was giving their right names when it was interrupted."""
    return sorted(p for p in log.iterdir() if _MISNAMED.fullmatch(p.name))


def list_growing(log: Path) -> list[SegmentPath]:
    """`list_segments` beside a writer: a folder that is read while a file takes another's place may
    show neither. Bases only ever join, so two listings with the same ones missed nothing."""
    before = list_segments(log)
    while True:
        now = list_segments(log)
        if [s.base for s in now] == [s.base for s in before]:
            return now
        before = now


def leftovers(log: Path) -> list[Path]:
    """Half-made files that a crash left behind; they hold nothing that is not elsewhere."""
    return sorted(p for p in log.iterdir() if p.name.endswith((NEW, SEALING)))


def free_name(path: Path, suffix: str) -> Path:
    """``path`` with a suffix that no other file has."""
    number = 1
    while True:
        counted = suffix if number == 1 else f"{suffix}-{number}"
        free = path.with_name(path.name + counted)
        if not free.exists():
            return free
        number += 1
