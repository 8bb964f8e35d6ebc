"""Names of the files of a log.

    00000000000000000000.mcap          sealed: immutable, compressed, indexed
    00000000000000004711.mcap.active   growing, or left over and not sealed yet
    ….mcap.new / .mcap.sealing         being made; means nothing until renamed, safe to delete
    ….mcap.damaged, .mcap.active.damaged   what `mapfold log recover` replaced, kept for a person
    lock                               held by the one writer

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
LOCK = "lock"

_NAME = re.compile(r"(\d{20})(\.mcap|\.mcap\.active)")


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
    for entry in log.iterdir():
        match = _NAME.fullmatch(entry.name)
        if match is None:
            continue
        segment = SegmentPath(entry, int(match[1]), match[2] == SEALED)
        if segment.sealed or segment.base not in found:
            found[segment.base] = segment
    return [found[base] for base in sorted(found)]


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
