"""A growing or left-over segment, read side. It has no index; its chunk heads and commit marks are
hopped over once (80 bytes each) and again only from where that ended."""

import os
from pathlib import Path

from eventsrc.envelope import Offset

from . import mcap_records as _mcap
from .durable_files import FileBytes
from .format import SEALED, mark_seed, segment_path
from .mcap_records import BadRecord, Channel
from .resync import Stretch, resume
from .segment import ChunkRef, SegmentFile, Unreadable


class ActiveFile(SegmentFile):
    """A growing or left-over segment, known as far as its commit marks go."""

    def __init__(self, path: Path, base: Offset) -> None:
        super().__init__(path, base)
        self.position = self.head_bytes
        self._seed = mark_seed(self.head)
        try:
            self.refresh()
        except BaseException:
            self.close()
            raise

    def refresh(self) -> Offset:
        """Take in what was committed since; the next offset."""
        try:
            while self._take_commit():
                pass
        except BadRecord:
            # Either a chunk is just being written or the end is torn: nothing more is durable.
            # Whether good chunks lie behind is asked once, by `LogReader` and by verify.
            pass
        return self.next_offset

    def _take_commit(self) -> bool:
        head_bytes = os.pread(self._fd, _mcap.PLAIN_CHUNK_HEAD, self.position)
        if len(head_bytes) < _mcap.PLAIN_CHUNK_HEAD:
            return False
        head = _mcap.decode_chunk_head(head_bytes)
        mark_at = self.position + head.length
        mark = os.pread(self._fd, _mcap.MARK_BYTES, mark_at)
        first, following = _mcap.decode_mark(mark, self._seed)
        if first != self.next_offset:
            raise BadRecord("a commit mark contradicts the one before it")
        chunk = ChunkRef(self.position, head.length, first, following)
        self.chunks.append(chunk)
        self.next_offset = following
        self.position = mark_at + _mcap.MARK_BYTES
        return True

    def was_replaced(self) -> bool:
        """Whether another file stands for this segment by now: sealed, or begun anew."""
        try:
            now = self.path.stat()
        except FileNotFoundError:
            return segment_path(self.path.parent, self.base, SEALED).exists()
        return now.st_ino != os.fstat(self._fd).st_ino

    def rot(self) -> Unreadable | None:
        """What once was durable behind the last readable commit. A crash tears only the end, and
        no commit mark can follow what was never synced; so where one does, bytes have rotted."""
        while self.position < self.size():
            with FileBytes(self._fd, self.position) as rest:
                promised = self._promised_in(rest)
            before = self.next_offset
            if self.refresh() == before:  # else a writer was at work between the two looks
                if promised <= before:
                    return None
                return Unreadable(before, Offset(promised - 1), f"damaged at byte {self.position}")
        return None

    def _promised_in(self, rest: FileBytes) -> Offset:
        """How far marks in ``rest``, which cannot be read, say that the segment was recorded."""
        stretch = Stretch(0, self.next_offset)
        at, promised = 0, self.next_offset
        while at < len(rest):
            at, said = resume(rest, at, stretch, self._seed)
            promised = max(promised, said)
        return promised

    def channels_of(self, body: bytes) -> dict[int, Channel]:
        """By id, from the records that lead the chunk."""
        _, channels = _mcap.definitions(body, leading=True)
        return {channel.id: channel for channel in channels}
