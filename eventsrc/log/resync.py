"""Resynchronise behind a damaged record of an active segment: find where reading can go on.

The file is a sequence of chunks, each followed by its commit mark. A mark counts only where a
record begins, because the payloads in a chunk may contain anything, marks included. So records are
skipped by their lengths:

* If the head of a chunk is good, its end is known even if its content is damaged. A chunk that
  would end behind the end of the file was being written when its writer died: nothing follows.
* If the head is damaged too, the next commit mark is searched for. It must be made with the mark
  seed of the segment, which publishers do not have, and must not declare more events than the bytes
  before it can hold.
"""

from typing import NamedTuple

from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .file_bytes import FileBytes
from .mcap_records import BadRecord


class Resumption(NamedTuple):
    """Reading can go on at byte ``at``; offsets before ``recorded_end`` were recorded, by a mark
    that was passed (the expected offset if there was none)."""

    at: int
    recorded_end: Offset


class DamagedBytes(NamedTuple):
    """Unreadable bytes from ``start`` on, where the event of offset ``expected`` should be."""

    start: int
    expected: Offset


def skip_damaged(data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None) -> Resumption:
    """Skip the damaged record at byte ``at``. Without the segment's mark ``seed`` no mark can be
    recognised."""
    end = _chunk_end(data, at)
    if end is None:
        if _chunk_end(data, at + _mcap.MARK_BYTES) is not None:  # a damaged mark
            return Resumption(at + _mcap.MARK_BYTES, damaged.expected)
        return _find_mark(data, at, damaged, seed)
    if end > len(data):
        return Resumption(len(data), damaged.expected)
    recorded_end = _recorded_end(data, end, damaged, seed)
    if recorded_end is not None:
        return Resumption(end + _mcap.MARK_BYTES, recorded_end)
    if _chunk_end(data, end + _mcap.MARK_BYTES) is not None:
        return Resumption(end + _mcap.MARK_BYTES, damaged.expected)
    return _find_mark(data, end, damaged, seed)


def _chunk_end(data: FileBytes, at: int) -> int | None:
    try:
        head = _mcap.decode_chunk_head(data[at : at + _mcap.PLAIN_CHUNK_HEAD])
    except BadRecord:
        return None
    return at + head.length


def _recorded_end(
    data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None
) -> Offset | None:
    """The next offset of the commit mark at byte ``at``; None without a plausible mark."""
    if seed is None:
        return None
    try:
        first, following = _mcap.decode_mark(data[at : at + _mcap.MARK_BYTES], seed)
    except BadRecord:
        return None
    max_events = (at - damaged.start) // _mcap.MESSAGE_HEAD
    if damaged.expected <= first < following <= damaged.expected + max_events:
        return following
    return None


def _find_mark(data: FileBytes, at: int, damaged: DamagedBytes, seed: int | None) -> Resumption:
    at -= 1
    while (at := data.find(_mcap.MARK_PATTERN, at + 1)) >= 0:
        recorded_end = _recorded_end(data, at, damaged, seed)
        if recorded_end is not None:
            return Resumption(at + _mcap.MARK_BYTES, recorded_end)
    return Resumption(len(data), damaged.expected)
