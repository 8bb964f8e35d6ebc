"""Read an active segment, growing or left over from a crash.

It has no index: its chunk heads and commit marks (80 bytes a commit) are read once, and later only
those that have been added. How far it was read follows from the chunks, which are added one by one,
so that an exception at any moment, such as that of Ctrl-C, leaves it right.
"""

import os
from pathlib import Path

from eventsrc.envelope.model import Offset

from . import mcap_records as _mcap
from .file_bytes import FileBytes
from .format import SEALED, mark_seed, segment_path
from .mcap_records import BadRecord, Channel, Schema
from .resync import DamagedBytes, skip_damaged
from .segment import ChunkRef, SegmentFile, Unreadable


class ActiveFile(SegmentFile):
    """An active segment up to its last commit mark."""

    def __init__(self, path: Path, base: Offset) -> None:
        super().__init__(path, base)
        self._seed = mark_seed(self.head)
        try:
            self.refresh()
        except BaseException:
            self.close()
            raise

    @property
    def position(self) -> int:
        """The byte after the last commit mark that was read."""
        if not self.chunks:
            return self.head_bytes
        last = self.chunks[-1]
        return last.position + last.length + _mcap.MARK_BYTES

    def refresh(self) -> Offset:
        """Read the commit marks added since the last call; return the next offset."""
        try:
            while self._read_commit():
                pass
        except BadRecord:
            # A chunk that is being written, a torn end, or damage, which `damaged_end` finds.
            pass
        return self.next_offset

    def _read_commit(self) -> bool:
        position = self.position
        head_bytes = os.pread(self._fd, _mcap.PLAIN_CHUNK_HEAD, position)
        if len(head_bytes) < _mcap.PLAIN_CHUNK_HEAD:
            return False
        head = _mcap.decode_chunk_head(head_bytes)
        mark = os.pread(self._fd, _mcap.MARK_BYTES, position + head.length)
        first, following = _mcap.decode_mark(mark, self._seed)
        if first != self.next_offset:
            raise BadRecord("a commit mark contradicts the one before it")
        self.chunks.append(ChunkRef(position, head.length, first, following))
        return True

    def was_replaced(self) -> bool:
        """Whether this segment is another file now: the sealed one, or a new active one."""
        try:
            now = self.path.stat()
        except FileNotFoundError:
            return segment_path(self.path.parent, self.base, SEALED).exists()
        return now.st_ino != os.fstat(self._fd).st_ino

    def damaged_end(self) -> Unreadable | None:
        """The durable events after the last readable commit, None if there are none.

        No commit mark follows bytes that were never synced, such as a torn end. So where a mark
        follows, recorded bytes are damaged.
        """
        while self.position < self.size():
            with FileBytes(self._fd, self.position) as rest:
                recorded_end = self._recorded_end_in(rest)
            before = self.next_offset
            if self.refresh() == before:  # else a writer has added commits meanwhile
                if recorded_end <= before:
                    return None
                return Unreadable(
                    before, Offset(recorded_end - 1), f"damaged at byte {self.position}"
                )
        return None

    def _recorded_end_in(self, rest: FileBytes) -> Offset:
        """The end of what was recorded, by the commit marks found in the unreadable ``rest``."""
        damaged = DamagedBytes(0, self.next_offset)
        at, recorded_end = 0, self.next_offset
        while at < len(rest):
            at, marked_end = skip_damaged(rest, at, damaged, self._seed)
            recorded_end = max(recorded_end, marked_end)
        return recorded_end

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """The channels of a chunk by id, from the records before its first message."""
        _, channels = _mcap.definitions(body, leading=True)
        return {channel.id: channel for channel in channels}

    def schemas_of(self, body: bytes) -> dict[int, Schema]:
        """The schemas of a chunk by id, from the records before its first message."""
        schemas, _ = _mcap.definitions(body, leading=True)
        return {schema.id: schema for schema in schemas}
