"""Names of a log's files, and the head of every segment.

    00000000000000000000.mcap          sealed: immutable, compressed, indexed
    00000000000000004711.mcap.active   growing, or left over and not sealed yet
    00000000000000000000.mcap.away     stands for a segment that is in an archive only: `away`
    ….mcap.new / .mcap.sealing         being made; worthless until renamed, safe to delete
    ….mcap.damaged, .mcap.active.damaged   originals that `mapfold log recover` replaced
    ….foreign, ….duplicate                 set aside by it: of another log; events of other segments
    ….misnamed                             a segment that it is giving its right name
    lock                               held by the one writer
    .ledger.json                       the gap ledger, folded from the events: a cache
    .archive.json, .archive.lock       where the log is archived: see `archive_place`
    .sealed.json                       how far the log is sealed: see `sealed_end`

A segment is named by its base, the offset of its first event. While a sealed file replaces its
active one, both exist for an instant; the sealed one counts. The head is magic, MCAP header and
metadata that name log and base.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.base.text import advised
from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .mcap_records import BadRecord, Header, Metadata, Opcode

FORMAT = "1"
SEGMENT_METADATA = "mapfold.segment"
"""First part of the name of a segment's head: see `metadata_name`."""
BEGUN = "begun_ns"
"""In the head of a segment: the clock of the machine that wrote it, when it was begun. Events that
are imported have the time of the drive. None after a recovery that could not read it."""
IMPORTED = "imported"
"""In the head of a segment that an import wrote: the time of its first event may lie before the
events before it."""
PREVIOUS = "previous_sha256"
"""In the head of a sealed segment, and of no active one: the hash of the segment before."""
FOLLOWING = "following"
"""In the head of a sealed segment: the offset after its last event, so that a file that was cut
tells what is missing."""
MARK_SEED = "mark_seed"
"""In the head of an active segment, in hex: see `mcap_records.encode_mark`."""
_SEED = re.compile(r"[0-9a-f]{1,8}")
_BASE = re.compile(r"\d{1,20}", re.ASCII)
_NUMBER = re.compile(r"[0-9]{1,19}")
_HEADER = Header(profile=_mcap.PROFILE, library=_mcap.LIBRARY)
HEAD_BYTES = 4096
"""More than any head takes."""


def metadata_name(kind: str, log_id: str, base: Offset) -> str:
    """The name of a segment's metadata record of this kind, which no other segment of any log has:
    `mcap merge` refuses files with metadata of the same name."""
    return f"{kind}:{log_id}:{base}"


def is_metadata_of(kind: str, name: str) -> bool:
    """Whether ``name`` is a `metadata_name` of this kind, of any segment."""
    return name.startswith(f"{kind}:")


def head_metadata(log_id: str, base: Offset, extra: dict[str, str] | None = None) -> Metadata:
    """The metadata at the head of a segment, active or sealed."""
    values = {"format": FORMAT, "log_id": log_id, "base": str(base), **(extra or {})}
    return _mcap.metadata_with_crc(metadata_name(SEGMENT_METADATA, log_id, base), values)


def read_number(text: str) -> Offset:
    """An offset in decimal digits; ValueError for anything else."""
    if not _NUMBER.fullmatch(text):
        raise ValueError(f"{text[:40]!r} is no offset")
    return Offset(int(text))


def end_in(head: dict[str, str], base: Offset) -> Offset:
    """Where a segment ends by its head; its base if the head does not say."""
    return max(base, Offset(int(head.get(FOLLOWING, base))))


def origin_notes(head: dict[str, str]) -> dict[str, str]:
    """What a sealed segment takes over from the head of the active one: when it was begun, and
    whether by an import."""
    return {name: head[name] for name in (BEGUN, IMPORTED) if name in head}


def file_head(metadata: Metadata) -> bytes:
    """Magic, header and ``metadata``."""
    return _mcap.MAGIC + _mcap.encode_all([_HEADER, metadata])


def mark_seed(head: dict[str, str]) -> int:
    """The mark seed in the head of an active segment; 0 for a sealed one under the name of one,
    which has no marks."""
    return int(head.get(MARK_SEED, "0"), 16)


class WrongPlace(LogDamaged):
    """A segment under the name of another one. Inside ``eventsrc.log`` only."""


class ForeignSegment(NotALog):
    """An MCAP file of another program, or a segment of a version that was never released. Inside
    ``eventsrc.log`` only."""


def head_of(path: Path, base: Offset) -> dict[str, str]:
    """Metadata at the head of the segment at ``path``; errors as `read_head`."""
    with path.open("rb") as file:
        return read_head(path, file.read(HEAD_BYTES), base)[0]


def head_at_any_base(path: Path) -> dict[str, str]:
    """Metadata at the head of the segment at ``path``, with any base; errors as `read_head`, but no
    WrongPlace."""
    with path.open("rb") as file:
        return _read_head(path, file.read(HEAD_BYTES))[0]


def read_head(path: Path, data: bytes, base: Offset) -> tuple[dict[str, str], int]:
    """Metadata at the head of a segment, and the position after it. Raises WrongPlace if it is not
    the segment at offset ``base``, LogDamaged if it is unreadable, NotALog if it is no segment:
    ForeignSegment if it is an MCAP file."""
    values, end = _read_head(path, data)
    if values["base"] != str(base):
        raise WrongPlace(
            f"{path} was written as the segment at offset {values['base']}, not {base}; "
            f"run `{advised('log', 'recover', path.parent)}`, which gives files their right names"
        )
    return values, end


def _read_head(path: Path, data: bytes) -> tuple[dict[str, str], int]:
    if not data.startswith(_mcap.MAGIC) and not _mcap.MAGIC.startswith(data):
        raise NotALog(
            f"{path} is no MCAP file; move it away if it does not belong in a log, and run "
            f"`{advised('log', 'recover', path.parent)}`"
        )
    try:
        return _find_head(data)
    except BadRecord as error:
        raise LogDamaged(
            f"{path}: damaged head: {error}; run `{advised('log', 'recover', path.parent)}`"
        ) from None
    except _Foreign as error:
        raise ForeignSegment(
            f"{path} is {error}, no segment of a log; `{advised('import', 'LOG', path)}` reads it"
        ) from None


class _Foreign(Exception):
    """What a file is that has no head of ours."""


def _find_head(data: bytes) -> tuple[dict[str, str], int]:
    """Metadata and end of a head."""
    at = len(_mcap.MAGIC)
    for opcode, content in _mcap.records(data[at:]):
        at += _mcap.FRAME.size + len(content)
        if opcode == Opcode.HEADER and not _is_own_header(content):
            raise _Foreign("an MCAP file of another program, as `mcap sort` makes of a segment")
        if opcode == Opcode.METADATA:
            metadata = _mcap.decode_as(Metadata, content)
            if metadata.name == SEGMENT_METADATA:
                raise _Foreign("an MCAP file of a version of mapfold that was never released")
            if is_metadata_of(SEGMENT_METADATA, metadata.name):
                return _checked_head(metadata), at
    raise BadRecord("it ends before the segment's metadata")


def _is_own_header(content: bytes) -> bool:
    """Whether an MCAP header is that of a segment, also where bits of its texts are flipped."""
    header = _mcap.decode_as(Header, content)
    if (header.profile, header.library) == (_mcap.PROFILE, _mcap.LIBRARY):
        return True
    return len(content) == len(_mcap.encode(_HEADER)) - _mcap.FRAME.size


def _checked_head(metadata: Metadata) -> dict[str, str]:
    values = _mcap.checked_metadata(metadata)
    if (FOLLOWING if PREVIOUS in values else MARK_SEED) not in values:
        raise _Foreign("an MCAP file of a version of mapfold that was never released")
    if not _BASE.fullmatch(values.get("base", "")) or "log_id" not in values:
        raise BadRecord("the segment's metadata has no log id or no base")
    if not _SEED.fullmatch(values.get(MARK_SEED, "0")):
        raise BadRecord("the segment's metadata has an invalid mark seed")
    if not _NUMBER.fullmatch(values.get(FOLLOWING, "0")):
        raise BadRecord("the segment's metadata has an invalid end")
    if not _NUMBER.fullmatch(values.get(BEGUN, "0")):
        raise BadRecord("the segment's metadata has an invalid time")
    return values


SEALED = ".mcap"
ACTIVE = ".mcap.active"
AWAY = ".mcap.away"
NEW = ".mcap.new"
SEALING = ".mcap.sealing"
DAMAGED = ".damaged"
FOREIGN = ".foreign"
DUPLICATE = ".duplicate"
MISNAMED = ".misnamed"
LOCK = "lock"
LEDGER = ".ledger.json"
SEALED_END = ".sealed.json"
ARCHIVE = ".archive.json"
ARCHIVE_LOCK = ".archive.lock"

_NAME = re.compile(r"(\d{20})(\.mcap|\.mcap\.active|\.mcap\.away)")
_MISNAMED = re.compile(_NAME.pattern + r"\.misnamed(-\d+)?")


@dataclass(frozen=True, slots=True)
class SegmentPath:
    """A segment's file, its base offset and whether it is sealed, here or away."""

    path: Path
    base: Offset
    sealed: bool

    @property
    def away(self) -> bool:
        """Whether the segment is in an archive only, and the file stands for it."""
        return self.path.name.endswith(AWAY)


def segment_path(log: Path, base: Offset, suffix: str) -> Path:
    """The file of the segment at offset ``base``, with one of the suffixes above."""
    return log / f"{base:020d}{suffix}"


def list_segments(log: Path) -> list[SegmentPath]:
    """The segments of ``log`` in offset order, one for each base: what is here before what is away,
    sealed before active."""
    found: dict[int, SegmentPath] = {}
    for segment in segment_files(log):
        known = found.get(segment.base)
        if known is None or (segment.sealed and not known.sealed):
            found[segment.base] = segment
    return [found[base] for base in sorted(found)]


def segment_files(log: Path) -> list[SegmentPath]:
    """All files of ``log`` with a segment's name; two of one base while it is being sealed."""
    return [s for s in _with_segment_names(log) if not _is_other(s.path)]


def not_files(log: Path) -> list[Path]:
    """What has the name of a segment and is no file: a folder, a pipe, a device. Opening one may
    wait for ever, so these count as missing segments. A link to a disk that is away does not."""
    return [s.path for s in _with_segment_names(log) if _is_other(s.path)]


def _is_other(path: Path) -> bool:
    return path.exists() and not path.is_file()


def _with_segment_names(log: Path) -> list[SegmentPath]:
    matches = ((entry, _NAME.fullmatch(entry.name)) for entry in log.iterdir())
    return sorted(
        (
            SegmentPath(entry, Offset(int(m[1])), m[2] != ACTIVE)
            for entry, m in matches
            if m is not None
        ),
        key=lambda segment: segment.path.name,
    )


def half_renamed(log: Path) -> list[Path]:
    """Segments whose renaming by `mapfold log recover` was interrupted."""
    return sorted(p for p in log.iterdir() if _MISNAMED.fullmatch(p.name))


def list_growing(log: Path) -> list[SegmentPath]:
    """`list_segments` beside a writer. A folder read while a file replaces another may show
    neither; bases are never removed, so two listings with the same bases are complete."""
    before = list_segments(log)
    while True:
        now = list_segments(log)
        if [s.base for s in now] == [s.base for s in before]:
            return now
        before = now


def leftovers(log: Path) -> list[Path]:
    """Half-made files that a crash left behind; everything in them is also in other files."""
    return sorted(p for p in log.iterdir() if p.name.endswith((NEW, SEALING)))


def free_name(path: Path, suffix: str) -> Path:
    """``path`` with ``suffix``, and a number if that file exists."""
    number = 1
    while True:
        counted = suffix if number == 1 else f"{suffix}-{number}"
        free = path.with_name(path.name + counted)
        if not free.exists():
            return free
        number += 1
