"""Where reading can go on behind a damaged record of an active segment.

The file is a row of chunks, each with its commit mark behind it. A mark counts only where a record
begins, for the bytes in a chunk are other people's and may look like anything. So the walk goes by
the lengths of the records:

* Where the head of a chunk is good, its end is known, whatever has become of its content. A chunk
  that would end behind the end of the file was being written when its writer died: nothing follows.
* Where the head is damaged as well, nobody knows where the next record begins, and the next commit
  mark is searched for. A mark found so must be made with the seed of its segment, which only its
  writer and who can read the file know, and must promise no more events than the bytes before it
  can hold.
"""

from typing import NamedTuple

from eventsrc.envelope import Offset

from . import mcap_records as _mcap
from .durable_files import FileBytes
from .mcap_records import BadRecord


class Resumption(NamedTuple):
    """Byte ``at`` is where reading can go on; a mark on the way promises that offsets up to before
    ``promised`` were recorded (what was expected there, if no mark does)."""

    at: int
    promised: Offset


class Stretch(NamedTuple):
    """What cannot be read: from byte ``start`` on, where offset ``expected`` should stand."""

    start: int
    expected: Offset


def resume(data: FileBytes, at: int, stretch: Stretch, seed: int | None) -> Resumption:
    """Pass by the damaged record at byte ``at`` of an unreadable stretch. Without the segment's
    ``seed`` no mark can be told from bytes that look like one."""
    end = _chunk_end(data, at)
    if end is None:
        if _chunk_end(data, at + _mcap.MARK_BYTES) is not None:  # a damaged mark
            return Resumption(at + _mcap.MARK_BYTES, stretch.expected)
        return _search(data, at, stretch, seed)
    if end > len(data):
        return Resumption(len(data), stretch.expected)
    promised = _promised(data, end, stretch, seed)
    if promised is not None:
        return Resumption(end + _mcap.MARK_BYTES, promised)
    if _chunk_end(data, end + _mcap.MARK_BYTES) is not None:
        return Resumption(end + _mcap.MARK_BYTES, stretch.expected)
    return _search(data, end, stretch, seed)


def _chunk_end(data: FileBytes, at: int) -> int | None:
    try:
        head = _mcap.decode_chunk_head(data[at : at + _mcap.PLAIN_CHUNK_HEAD])
    except BadRecord:
        return None
    return at + head.length


def _promised(data: FileBytes, at: int, stretch: Stretch, seed: int | None) -> Offset | None:
    """The next offset of the mark at byte ``at``, if one stands there and can be true."""
    if seed is None:
        return None
    try:
        first, following = _mcap.decode_mark(data[at : at + _mcap.MARK_BYTES], seed)
    except BadRecord:
        return None
    most = (at - stretch.start) // _mcap.MESSAGE_HEAD
    if stretch.expected <= first < following <= stretch.expected + most:
        return following
    return None


def _search(data: FileBytes, at: int, stretch: Stretch, seed: int | None) -> Resumption:
    at -= 1
    while (at := data.find(_mcap.MARK_PATTERN, at + 1)) >= 0:
        promised = _promised(data, at, stretch, seed)
        if promised is not None:
            return Resumption(at + _mcap.MARK_BYTES, promised)
    return Resumption(len(data), stretch.expected)
