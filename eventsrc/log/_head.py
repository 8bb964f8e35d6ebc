"""The head of every segment: magic, MCAP header, and metadata that say whose segment it is."""

import re
from pathlib import Path

from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._mcap import BadRecord, Header, Metadata, Opcode

FORMAT = "1"
SEGMENT_METADATA = "mapfold.segment"
PREVIOUS = "previous_sha256"
"""In the head of a sealed segment, and of no active one: the hash of the segment before."""
MARK_SEED = "mark_seed"
"""In the head of an active segment: what its commit marks are made with, in hex. Segments of
earlier versions have none, which is seed 0."""
_SEED = re.compile(r"[0-9a-f]{1,8}")
_BASE = re.compile(r"\d{1,20}", re.ASCII)
HEAD_BYTES = 4096
"""More than any head of ours takes."""


def head_metadata(log_id: str, base: int, extra: dict[str, str] | None = None) -> Metadata:
    """What stands at the head of every segment, active and sealed."""
    values = {"format": FORMAT, "log_id": log_id, "base": str(base), **(extra or {})}
    return _mcap.own_metadata(SEGMENT_METADATA, values)


def file_head(metadata: Metadata) -> bytes:
    """Magic, header and our metadata."""
    header = Header(profile=_mcap.PROFILE, library=_mcap.LIBRARY)
    return _mcap.MAGIC + _mcap.encode_all([header, metadata])


def mark_seed(head: dict[str, str]) -> int:
    """The mark seed that the head of an active segment names."""
    return int(head.get(MARK_SEED, "0"), 16)


class WrongPlace(LogDamaged):
    """A whole segment under the name of another one. Inside ``eventsrc.log`` only."""


def head_of(path: Path, base: int) -> dict[str, str]:
    """Our metadata at the head of the segment at ``path``; see `read_head`."""
    with path.open("rb") as file:
        return read_head(path, file.read(HEAD_BYTES), base)[0]


def claims_of(path: Path) -> dict[str, str]:
    """The same, whatever base the head names."""
    with path.open("rb") as file:
        return _read_head(path, file.read(HEAD_BYTES))[0]


def read_head(path: Path, data: bytes, base: int) -> tuple[dict[str, str], int]:
    """Our metadata at the head of a segment and the byte after it. Raises WrongPlace when it is not
    the segment at offset ``base``, LogDamaged when it cannot be read, NotALog when it is none."""
    values, end = _read_head(path, data)
    if values["base"] != str(base):
        raise WrongPlace(
            f"{path} was written as the segment at offset {values['base']}, not {base}; "
            f"run `mapfold log recover {path.parent}`, which gives files their right names"
        )
    return values, end


def _read_head(path: Path, data: bytes) -> tuple[dict[str, str], int]:
    if not data.startswith(_mcap.MAGIC) and not _mcap.MAGIC.startswith(data):
        raise NotALog(f"{path} is no MCAP file; it does not belong into a log, move it away")
    try:
        head = _find_head(data)
    except BadRecord as error:
        raise LogDamaged(
            f"{path}: damaged head: {error}; run `mapfold log recover {path.parent}`"
        ) from None
    if head is None:
        raise NotALog(f"{path} is an MCAP file but no segment of a log; `mapfold import` reads it")
    return head


def _find_head(data: bytes) -> tuple[dict[str, str], int] | None:
    """None for an MCAP head that is not ours."""
    at = len(_mcap.MAGIC)
    ours = True
    try:
        for opcode, content in _mcap.records(data[at:]):
            at += _mcap.FRAME.size + len(content)
            if opcode == Opcode.HEADER:
                header = _mcap.decode_as(Header, content)
                ours = (header.profile, header.library) == (_mcap.PROFILE, _mcap.LIBRARY)
            elif opcode == Opcode.METADATA:
                metadata = _mcap.decode_as(Metadata, content)
                if metadata.name == SEGMENT_METADATA:
                    return _checked_head(metadata), at
    except BadRecord:
        if ours:
            raise
    if ours:
        raise BadRecord("it ends before the segment's metadata")
    return None


def _checked_head(metadata: Metadata) -> dict[str, str]:
    values = _mcap.checked_metadata(metadata)
    if not _BASE.fullmatch(values.get("base", "")) or "log_id" not in values:
        raise BadRecord("the segment's metadata names no log or no base")
    if not _SEED.fullmatch(values.get(MARK_SEED, "0")):
        raise BadRecord("the segment's metadata names no good mark seed")
    return values
