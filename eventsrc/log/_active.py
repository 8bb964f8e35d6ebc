"""The growing segment, written side.

    magic · Header · Metadata "mapfold.segment" · ( chunk · commit mark )*

One commit is: write one uncompressed chunk, sync it, write its commit mark. The mark is what a
reader in another process goes by: a chunk without one may not be on the disk yet and is not shown.
The mark itself needs no sync, for it says something only while the bytes before it are there; and
recovery, which has no writer to race with, takes every chunk whose CRC holds, mark or not.

A commit that fails leaves the file at the last good byte, and the segment refuses further work.
"""

import os
import time
import zlib
from pathlib import Path

from eventsrc.errors import LogError

from . import _mcap
from ._head import file_head, head_metadata
from ._mcap import Channel, Schema
from ._naming import ACTIVE, NEW, segment_path
from ._schemas import key_channel, schema_of
from .fsync import FsyncPolicy, replace_durably, sync_file, write_all


class ActiveSegment:
    """Events go in by `append` and count once `commit` has returned."""

    def __init__(self, log: Path, log_id: str, base: int, policy: FsyncPolicy) -> None:
        self.path = segment_path(log, base, ACTIVE)
        self.base = base
        self.committed = base
        self.next_offset = base
        self._policy = policy
        self._channels: dict[tuple[str, int], Channel] = {}
        self._used: set[int] = set()
        self._schemas: dict[str, int] = {}
        self._definitions: list[bytes] = []
        self._parts: list[bytes] = []
        self._waiting_bytes = 0
        self._first_ns = self._last_ns = 0
        self._oldest_wait = 0
        self._failure: str | None = None
        self.size = self._create(segment_path(log, base, NEW), log_id)
        self._fd = os.open(self.path, os.O_WRONLY | os.O_APPEND)

    def _create(self, temporary: Path, log_id: str) -> int:
        data = file_head(head_metadata(log_id, self.base))
        fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            write_all(fd, data)
            sync_file(fd)
        finally:
            os.close(fd)
        replace_durably(temporary, self.path)
        return len(data)

    @property
    def waiting(self) -> int:
        """Events appended and not committed."""
        return self.next_offset - self.committed

    def append(self, key: str, version: int, payload: bytes, logged_ns: int, stamp_ns: int) -> int:
        """Take one event; its offset. Commits when the policy says so."""
        self._check()
        channel = self._channel(key, version)
        if not self.waiting:
            self._oldest_wait = time.monotonic_ns()
            self._first_ns = self._last_ns = logged_ns
        elif logged_ns < self._first_ns:
            self._first_ns = logged_ns
        elif logged_ns > self._last_ns:
            self._last_ns = logged_ns
        offset = self.next_offset
        size = len(payload)
        head = _mcap.encode_message_head(channel, offset - self.base, logged_ns, stamp_ns, size)
        self._parts += (head, payload)
        self._waiting_bytes += len(head) + size
        self.next_offset = offset + 1
        return offset

    def _channel(self, key: str, version: int) -> int:
        """The channel's id. Its record leads every chunk that uses it, so that no rot in one chunk
        can take the names from another's events; the schema, which the key tells, stands once."""
        known = self._channels.get((key, version))
        if known is None:
            known = self._channels[key, version] = self._define(key, version)
        if known.id not in self._used:
            self._used.add(known.id)
            self._definitions.append(_mcap.encode(known))
        return known.id

    def _define(self, key: str, version: int) -> Channel:
        name, text = schema_of(key)
        schema = self._schemas.get(name)
        if schema is None:
            schema = self._schemas[name] = len(self._schemas) + 1
            record = Schema(id=schema, name=name, encoding="jsonschema", data=text)
            self._definitions.append(_mcap.encode(record))
        return key_channel(len(self._channels) + 1, schema, key, version)

    def due(self) -> bool:
        """True when the policy wants a commit now."""
        policy = self._policy
        return self.waiting > 0 and (
            self.waiting >= policy.max_events
            or self._waiting_bytes >= policy.max_bytes
            or time.monotonic_ns() - self._oldest_wait >= policy.interval_ns
        )

    def commit(self) -> None:
        """Bring everything appended to the disk, then say so. Raises LogError; then all is as
        before the commit, and no further work is taken."""
        self._check()
        if not self.waiting:
            return
        lead, body = b"".join(self._definitions), b"".join(self._parts)
        size = len(lead) + len(body)
        crc = zlib.crc32(body, zlib.crc32(lead))
        head = _mcap.encode_plain_chunk_head(size, crc, self._first_ns, self._last_ns)
        mark = _mcap.encode_mark(self.committed, self.next_offset)
        try:
            write_all(self._fd, head + lead)
            write_all(self._fd, body)  # not joined to its head: it is megabytes
            if self._policy.syncs:
                sync_file(self._fd)
            write_all(self._fd, mark)
        except OSError as error:
            raise self._fail(error) from error
        self.size += len(head) + size + len(mark)
        self.committed = self.next_offset
        self._definitions.clear()
        self._used.clear()
        self._parts.clear()
        self._waiting_bytes = 0

    def _check(self) -> None:
        if self._failure is not None:
            raise LogError(self._failure)

    def _fail(self, error: OSError) -> LogError:
        """Cut off what is half written. After a failed sync nobody knows which pages are on the
        disk, and after a full disk the next write fails as well: the writer must start anew."""
        message = (
            f"{self.path}: {error.strerror or error}: {self.waiting} events after offset "
            f"{self.committed} could not be written; every event before it is safe. "
            "Free space or fix the disk, then start again"
        )
        try:
            os.ftruncate(self._fd, self.size)
        except OSError as cut_error:
            message += f" (the torn end stays: {cut_error.strerror}; recovery ignores it)"
        return self.refuse(message)

    def refuse(self, message: str) -> LogError:
        """From now on every append and commit raises this."""
        self._failure = message
        return LogError(message)

    def close(self) -> None:
        """Let go of the file. Does not commit."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
