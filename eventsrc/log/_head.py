"""The head of every segment: magic, MCAP header, and metadata that say whose segment it is."""

from pathlib import Path

from eventsrc.errors import LogDamaged, NotALog

from . import _mcap
from ._mcap import BadRecord, Header, Metadata, Opcode

FORMAT = "1"
SEGMENT_METADATA = "mapfold.segment"
MARK_SEED = "mark_seed"
"""In the head of an active segment: what its commit marks are made with, in hex. Segments of
earlier versions have none, which is seed 0."""
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


def head_of(path: Path, base: int) -> dict[str, str]:
    """Our metadata at the head of the segment at ``path``; see `read_head`."""
    with path.open("rb") as file:
        return read_head(path, file.read(HEAD_BYTES), base)[0]


def read_head(path: Path, data: bytes, base: int) -> tuple[dict[str, str], int]:
    """Our metadata at the head of a segment and the byte after it."""
    if not data.startswith(_mcap.MAGIC) and not _mcap.MAGIC.startswith(data):
        raise NotALog(f"{path} is no MCAP file; it does not belong into a log, move it away")
    try:
        head = _find_head(data, base)
    except BadRecord as error:
        raise LogDamaged(
            f"{path}: damaged head: {error}; run `mapfold log recover {path.parent}`"
        ) from None
    if head is None:
        raise NotALog(f"{path} is an MCAP file but no segment of a log; `mapfold import` reads it")
    return head


def _find_head(data: bytes, base: int) -> tuple[dict[str, str], int] | None:
    """None for an MCAP head that is not ours."""
    at = len(_mcap.MAGIC)
    profile = _mcap.PROFILE
    try:
        for opcode, content in _mcap.records(data[at:]):
            at += _mcap.FRAME.size + len(content)
            if opcode == Opcode.HEADER:
                profile = _mcap.decode_as(Header, content).profile
            elif opcode == Opcode.METADATA:
                metadata = _mcap.decode_as(Metadata, content)
                if metadata.name == SEGMENT_METADATA:
                    return _checked_head(metadata, base), at
    except BadRecord:
        if profile == _mcap.PROFILE:
            raise
    if profile == _mcap.PROFILE:
        raise BadRecord("it ends before the segment's metadata")
    return None


def _checked_head(metadata: Metadata, base: int) -> dict[str, str]:
    values = _mcap.checked_metadata(metadata)
    if values["base"] != str(base):
        raise BadRecord(f"it was written as the segment at offset {values['base']}, not {base}")
    return values
