"""Before a recovery: see to it that every file has the name that its head asks for.

The log id and the base in the head of a segment say which log and which offsets it holds; its name
may be wrong, for people copy, restore and rename. So:

* A segment of another log than most files here is set aside as ``….foreign``.
* A segment under another name than its own gets its own back.
* Of several files with the same base the one with the most good events stays, the others are set
  aside as ``….duplicate``.
* A file whose head is damaged is known by its name alone and keeps it, unless a whole one claims
  it: then it is set aside as ``….damaged``.
* An MCAP file that others wrote, without our metadata, may hold anything: nothing is done.

Nothing is deleted. Files that change places are renamed twice, by way of ``….misnamed``; a recovery
that was interrupted between the two finds them again.
"""

from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from eventsrc.envelope import Offset
from eventsrc.errors import LogDamaged, NotALog

from . import mcap_records as _mcap
from .durable_files import sync_directory
from .format import (
    ACTIVE,
    DAMAGED,
    DUPLICATE,
    FOREIGN,
    MISNAMED,
    PREVIOUS,
    SEALED,
    SegmentPath,
    claims_of,
    free_name,
    half_renamed,
    segment_files,
    segment_path,
)
from .log_identity import majority_of
from .scan import Scan, scan_active
from .scan_sealed import scan_sealed
from .sealed_segment import check_sealed


@dataclass(frozen=True, slots=True)
class Moved:
    """A file that has another name now, and why."""

    name: str
    now: str
    reason: str


@dataclass(frozen=True, slots=True)
class _File:
    """``wanted`` is the segment that the file holds by its own word, or by its name where its head
    cannot be read (``log_id`` is None then)."""

    path: Path
    wanted: SegmentPath
    log_id: str | None


def set_aside(path: Path, suffix: str, reason: str) -> Moved:
    """Take a file out of the log by renaming it."""
    aside = free_name(path, suffix)
    path.rename(aside)
    sync_directory(path.parent)
    return Moved(path.name, aside.name, reason)


class Arrangement:
    """`run` once, holding the writer lock. Raises LogDamaged, with nothing done, for segments of
    two logs equally often, and for MCAP files that others wrote."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self.moved: list[Moved] = []
        self.log_id: str | None = None

    def run(self) -> None:
        """Set aside and rename."""
        files = [_look_at(segment.path, segment) for segment in segment_files(self._log)]
        files += [_look_at(path, _as_named(path)) for path in half_renamed(self._log)]
        self.log_id = majority_of((f.path, f.log_id) for f in files if f.log_id is not None)
        wanted: defaultdict[Offset, list[_File]] = defaultdict(list)
        for file in files:
            if file.log_id in (None, self.log_id):
                wanted[file.wanted.base].append(file)
        for file in files:
            if file.log_id not in (None, self.log_id):
                reason = f"it belongs to log {file.log_id}, not {self.log_id}"
                self.moved.append(set_aside(file.path, FOREIGN, reason))
        bases = sorted(wanted)
        for base, following in zip(bases, [*bases[1:], None], strict=True):
            self._choose(wanted[base], following)
        self._rename([files[0] for files in wanted.values()])

    def _choose(self, files: list[_File], following: Offset | None) -> None:
        """Leave the best of ``files`` as the only one; the others are set aside."""
        if len(files) == 1 or _still_being_sealed(files):
            files.sort(key=lambda file: not file.wanted.sealed)
            return
        files.sort(key=lambda file: _worth(file, following), reverse=True)
        for file in files[1:]:
            if file.log_id is None:
                reason = "its head is damaged, and another file is this segment"
                self.moved.append(set_aside(file.path, DAMAGED, reason))
            else:
                reason = f"{files[0].wanted.path.name} holds the same offsets"
                self.moved.append(set_aside(file.path, DUPLICATE, reason))

    def _rename(self, files: list[_File]) -> None:
        for file in [f for f in files if f.path != f.wanted.path]:
            between = file.path
            if not file.path.name.startswith(file.wanted.path.name + MISNAMED):
                between = free_name(file.wanted.path, MISNAMED)
                file.path.rename(between)
            reason = f"its head says that it begins at offset {file.wanted.base}"
            self.moved.append(Moved(file.path.name, file.wanted.path.name, reason))
        sync_directory(self._log)
        for path in half_renamed(self._log):
            path.rename(_as_named(path).path)
        sync_directory(self._log)


def _as_named(path: Path) -> SegmentPath:
    """The segment that a half-renamed file is to be."""
    name = path.name.partition(MISNAMED)[0]
    return SegmentPath(path.with_name(name), Offset(int(name[:20])), name.endswith(SEALED))


def _look_at(path: Path, named: SegmentPath) -> _File:
    try:
        claims = claims_of(path)
    except LogDamaged:
        return _File(path, named, None)
    except NotALog:
        damaged = _File(path, named, None)
        if _is_mcap(path) and not _grew_here(damaged):
            raise LogDamaged(_not_ours(path)) from None
        return damaged
    base, sealed = Offset(int(claims["base"])), PREVIOUS in claims
    where = segment_path(path.parent, base, SEALED if sealed else ACTIVE)
    return _File(path, SegmentPath(where, base, sealed), claims["log_id"])


def _grew_here(file: _File) -> bool:
    """Whether a growing segment whose head is damaged has chunks as only a writer of ours makes
    them; no other program names a file ``.mcap.active``."""
    return not file.wanted.sealed and bool(_scan(file).chunks)


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_mcap.MAGIC)) == _mcap.MAGIC


def _not_ours(path: Path) -> str:
    log = path.parent
    return (
        f"{path} was written by another program and does not say which offsets it holds; nothing "
        f"was changed. Put the original back, or move the file out of {log}, run `mapfold log "
        f"recover {log}` if other segments are there, and append what it holds by `mapfold import "
        f"{log} FILE`"
    )


def _still_being_sealed(files: list[_File]) -> bool:
    """Whether these are a whole sealed segment and the active one that it was made from, which a
    crash has left."""
    if {file.path.name for file in files} != {
        segment_path(file.path.parent, files[0].wanted.base, suffix).name
        for file in files
        for suffix in (SEALED, ACTIVE)
    }:
        return False
    sealed, active = sorted(files, key=lambda file: not file.wanted.sealed)
    if not sealed.wanted.sealed or active.wanted.sealed or check_sealed(sealed.path).fault:
        return False
    scan = _scan(active)
    return scan.next_offset <= _scan(sealed).next_offset


def _worth(file: _File, following: Offset | None) -> tuple[int, bool, bool]:
    """The most good events before the next segment; then the right name; then sealed."""
    events = sum(
        chunk.following - chunk.first
        for chunk in _scan(file).chunks
        if following is None or chunk.first < following
    )
    return events, file.path == file.wanted.path, file.wanted.sealed


def _scan(file: _File) -> Scan:
    if file.wanted.sealed:
        return scan_sealed(file.path, file.wanted.base, None)
    return scan_active(file.path, file.wanted.base)
