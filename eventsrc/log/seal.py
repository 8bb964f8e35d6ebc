"""Seal a segment: chunk, compress and index it, with every byte under a checksum.

    magic · Header · Metadata "mapfold.segment:…" · ( chunk · message indexes )* ·
    Metadata "mapfold.seal:…" · DataEnd with the CRC of all before it ·
    summary with its CRC · Footer · magic

The file is written as ``.mcap.sealing``, synced and renamed, so a file with a sealed name is always
complete. Chunks of a growing segment are as large as its commits; they are joined or split to about
`CHUNK_BYTES`, which bounds what a flipped bit can cost and what reading one event takes. Events are
copied as they are; only their heads are parsed, for the index. The channel records that a chunk
needs lead it.

The seal holds the number of events in each chunk, which the MCAP index does not, so that an offset
is found without reading chunks. The head holds the SHA-256 of the segment before: the chain. It
also names the segment's end, so that a file that was cut tells what is missing.
"""

import hashlib
import os
import struct
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from eventsrc.base.errors import LogDamaged
from eventsrc.base.machine import crc32
from eventsrc.envelope.model import Offset

from . import format as names
from . import mcap_records as _mcap
from .channels import is_verbatim
from .durable_files import drop_cached, replace_durably, sync_file, unlink_quietly, write_all
from .sealed_segment import SEAL_METADATA

CHUNK_BYTES = 1024 * 1024
_SYNC_BYTES = 4 * 1024 * 1024
"""Bytes synced at a time. Syncing a whole segment at once delays the commits of the growing segment
by up to 40 ms, this by 10 ms at most."""


@dataclass(frozen=True, slots=True)
class ChunkBody:
    """The body of a chunk to be written, and columns of its messages' heads.

    ``positions`` are the messages' starts in the body. ``definitions`` are the schema and channel
    records of the joined chunks, in the first body made of them; later ones have none.
    """

    body: bytes
    channels: Sequence[int]
    log_ns: Sequence[int]
    stamp_ns: Sequence[int]
    positions: Sequence[int]
    definitions: bytes

    def entries(self) -> dict[int, list[int]]:
        """By channel: log time and position of each message, alternating, as in an MCAP index."""
        entries: dict[int, list[int]] = {channel: [] for channel in self.channels}
        for channel, log_ns, position in zip(
            self.channels, self.log_ns, self.positions, strict=True
        ):
            entries[channel] += (log_ns, position)
        return entries


def rechunk(bodies: Iterable[bytes]) -> Iterator[ChunkBody]:
    """Join or split chunk bodies, in offset order, to about `CHUNK_BYTES`."""
    waiting: list[bytes] = []
    size = 0
    for body in bodies:
        waiting.append(body)
        size += len(body)
        if size >= CHUNK_BYTES:
            yield from _split(b"".join(waiting))
            waiting, size = [], 0
    if waiting:
        yield from _split(b"".join(waiting))


def _split(body: bytes) -> Iterator[ChunkBody]:
    """Split a body of two chunks or more into bodies of about the same size."""
    rows, starts, others = _parse(body)
    _, _, channels, _, log_ns, stamp_ns = zip(*rows, strict=True)
    definitions = b"".join(body[start:end] for start, end in others)
    lead = b""
    edges, view = _edges(len(body), starts), memoryview(body)
    for first, last in pairwise(edges):
        at = starts[first] if first else 0
        end = starts[last] if last < len(starts) else len(body)
        shift = len(lead) - at
        yield ChunkBody(
            b"".join((lead, view[at:end])) if len(edges) > 2 else body,
            channels[first:last],
            log_ns[first:last],
            stamp_ns[first:last],
            [start + shift for start in starts[first:last]],
            b"" if first else definitions,
        )
        lead = lead or _lead_of(definitions)


def _lead_of(definitions: bytes) -> bytes:
    """The records that lead a body which was split off: all channels, and the schemas of verbatim
    messages, which follow from nothing else."""
    schemas, channels = _mcap.definitions(definitions)
    verbatim = {channel.schema_id for channel in channels if is_verbatim(channel)}
    needed = {schema.id: schema for schema in schemas if schema.id in verbatim}
    return _mcap.encode_all([*needed.values(), *channels])


def _edges(size: int, starts: list[int]) -> list[int]:
    """Indexes of the messages that the bodies begin with, and the number of messages."""
    count = max(1, size // CHUNK_BYTES)
    inner = {bisect_left(starts, size * part // count) for part in range(1, count)}
    return sorted({0, len(starts)} | inner)


def _parse(body: bytes) -> tuple[list[tuple[int, ...]], list[int], list[tuple[int, int]]]:
    """Heads and starts of all messages, and start and end of every other record."""
    at, size, unpack, message = 0, len(body), _mcap.MESSAGE.unpack_from, int(_mcap.Opcode.MESSAGE)
    rows: list[tuple[int, ...]] = []
    starts: list[int] = []
    others: list[tuple[int, int]] = []
    try:
        while at < size:
            if body[at] == message:
                row = unpack(body, at)
                rows.append(row)
                if len(rows) > _mcap.MAX_MESSAGES:
                    raise _mcap.BadRecord(f"a chunk of more than {_mcap.MAX_MESSAGES:,} messages")
                starts.append(at)
                at += _mcap.FRAME.size + row[1]
            else:
                start, at = at, at + _mcap.FRAME.size + _mcap.FRAME.unpack_from(body, at)[1]
                others.append((start, at))
    except struct.error:
        raise _mcap.BadRecord("a record is cut short in a chunk") from None
    if at != size:
        raise _mcap.BadRecord("a record does not fit its chunk")
    return rows, starts, others


NO_PREVIOUS = ""
REPLACES = "replaces_sha256"
"""In the head of a recovered segment: the hash of its original, which its successor carries."""


@dataclass(frozen=True, slots=True)
class SegmentPlan:
    """Head of a sealed segment to be written: its log, base and the hash of the segment before.

    ``following`` is the offset after its last event. Bodies that end elsewhere are not sealed: the
    source is damaged, and must be kept for what else is in it.
    """

    log: Path
    log_id: str
    base: Offset
    previous_sha256: str
    following: Offset
    notes: dict[str, str] = field(default_factory=dict)


def seal(plan: SegmentPlan, bodies: Iterable[bytes]) -> str:
    """Write the sealed segment of chunk bodies in offset order; returns its SHA-256.

    Raises OSError, and LogDamaged for bodies that a writer does not make; leaves nothing then.
    """
    temporary = names.segment_path(plan.log, plan.base, names.SEALING)
    sha256 = write_sealed(plan, bodies, temporary)
    replace_durably(temporary, names.segment_path(plan.log, plan.base, names.SEALED))
    return sha256


def write_sealed(
    plan: SegmentPlan, bodies: Iterable[bytes], temporary: Path, *, cached: bool = True
) -> str:
    """`seal`, but only write and sync the file as ``temporary``, without renaming it. Unless it is
    to stay ``cached``, what is synced leaves the system's page cache."""
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    try:
        builder = _Builder(fd, plan, cached=cached)
        for body in rechunk(bodies):
            builder.add_chunk(body)
        builder.check_end(plan)
        builder.finish()
        builder.sync()
    except _mcap.BadRecord as error:
        unlink_quietly(temporary)
        raise LogDamaged(
            f"{names.segment_path(plan.log, plan.base, names.ACTIVE)}: {error}"
        ) from None
    except BaseException:
        unlink_quietly(temporary)
        raise
    finally:
        os.close(fd)
    return builder.sha256.hexdigest()


class _Builder:
    """Writes a sealed file front to back and collects position, checksums and index."""

    def __init__(self, fd: int, plan: SegmentPlan, *, cached: bool) -> None:
        self._fd = fd
        self._cached = cached
        self._at = 0
        self._synced = 0
        self._crc = 0
        self.sha256 = hashlib.sha256()
        self._compressor = _mcap.new_compressor()
        self._schemas: dict[int, _mcap.Schema] = {}
        self._channels: dict[int, _mcap.Channel] = {}
        self._counts: dict[int, int] = defaultdict(int)
        self._chunks: list[_mcap.ChunkIndex] = []
        self._metadata: list[_mcap.MetadataIndex] = []
        self._edges = [0]
        self._log_ns: list[int] = []
        self._stamp_ns: list[int] = []
        values = {
            names.PREVIOUS: plan.previous_sha256,
            names.FOLLOWING: str(plan.following),
            **plan.notes,
        }
        head = names.head_metadata(plan.log_id, plan.base, values)
        start = names.file_head(head)
        length = len(_mcap.encode(head))
        self._metadata.append(_mcap.MetadataIndex(len(start) - length, length, head.name))
        self._seal_name = names.metadata_name(SEAL_METADATA, plan.log_id, plan.base)
        self._write(start)

    def _write(self, data: bytes) -> None:
        write_all(self._fd, data)
        self._at += len(data)
        self._crc = crc32(data, self._crc)
        self.sha256.update(data)

    def sync(self) -> None:
        """Sync the bytes written so far."""
        sync_file(self._fd)
        if not self._cached:
            drop_cached(self._fd, self._synced, self._at)
        self._synced = self._at

    def add_chunk(self, body: ChunkBody) -> None:
        """Write a chunk and its message indexes."""
        schemas, channels = _mcap.definitions(body.definitions)
        self._schemas.update((s.id, s) for s in schemas)
        self._channels.update((c.id, c) for c in channels)
        self._edges.append(self._edges[-1] + len(body.log_ns))
        first_ns, last_ns = min(body.log_ns), max(body.log_ns)
        self._log_ns += (first_ns, last_ns)
        self._stamp_ns += (min(body.stamp_ns), max(body.stamp_ns))
        entries = body.entries()
        for channel_id, flat in entries.items():
            self._counts[channel_id] += len(flat) // 2
        self._write_chunk(body.body, first_ns, last_ns, entries)
        if self._at - self._synced >= _SYNC_BYTES:
            self.sync()

    def _write_chunk(
        self, body: bytes, first_ns: int, last_ns: int, entries: dict[int, list[int]]
    ) -> None:
        head, data = _mcap.encode_chunk(self._compressor, body, first_ns, last_ns)
        start = self._at
        self._write(head)
        self._write(data)
        indexes_at = self._at
        offsets: dict[int, int] = {}
        for channel_id in sorted(entries):
            offsets[channel_id] = self._at
            self._write(_mcap.encode_message_index(channel_id, entries[channel_id]))
        self._chunks.append(
            _mcap.ChunkIndex(
                chunk_length=len(head) + len(data),
                chunk_start_offset=start,
                compression="zstd",
                compressed_size=len(data),
                message_end_time=last_ns,
                message_index_length=self._at - indexes_at,
                message_index_offsets=offsets,
                message_start_time=first_ns,
                uncompressed_size=len(body),
            )
        )

    def check_end(self, plan: SegmentPlan) -> None:
        """Raise BadRecord unless the chunks end at the plan's end."""
        reached = plan.base + self._edges[-1]
        if reached != plan.following:
            raise _mcap.BadRecord(
                f"offsets {reached} to {plan.following - 1} were recorded and cannot be read"
            )

    def finish(self) -> None:
        """Write the seal, the end of data, the summary and the footer."""
        seal_record = _mcap.encode(self._seal())
        self._metadata.append(_mcap.MetadataIndex(self._at, len(seal_record), self._seal_name))
        self._write(seal_record)
        self._write(_mcap.encode(_mcap.DataEnd(self._crc)))
        self._write_summary()

    def _seal(self) -> _mcap.Metadata:
        return _mcap.metadata_with_crc(
            self._seal_name,
            {
                "chunk_edges": ",".join(map(str, self._edges)),
                "first_stamp_ns": str(min(self._stamp_ns)),
                "last_stamp_ns": str(max(self._stamp_ns)),
            },
        )

    def _write_summary(self) -> None:
        start = self._at
        summary = b""
        groups: list[_mcap.SummaryOffset] = []
        for opcode, data in self._summary_groups():
            groups.append(_mcap.SummaryOffset(opcode, start + len(summary), len(data)))
            summary += data
        offsets_start = start + len(summary)
        summary += _mcap.encode_all(groups)
        footer = _mcap.encode(_mcap.Footer(start, offsets_start, 0))
        crc = crc32(footer[:-4], crc32(summary))
        self._write(summary + _mcap.encode(_mcap.Footer(start, offsets_start, crc)) + _mcap.MAGIC)

    def _summary_groups(self) -> list[tuple[_mcap.Opcode, bytes]]:
        return [
            (_mcap.Opcode.SCHEMA, _mcap.encode_all(self._schemas.values())),
            (_mcap.Opcode.CHANNEL, _mcap.encode_all(self._channels.values())),
            (_mcap.Opcode.STATISTICS, _mcap.encode(self._statistics())),
            (_mcap.Opcode.CHUNK_INDEX, _mcap.encode_all(self._chunks)),
            (_mcap.Opcode.METADATA_INDEX, _mcap.encode_all(self._metadata)),
        ]

    def _statistics(self) -> _mcap.Statistics:
        return _mcap.Statistics(
            attachment_count=0,
            channel_count=len(self._channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._chunks),
            message_count=self._edges[-1],
            message_end_time=max(self._log_ns),
            message_start_time=min(self._log_ns),
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, as the next segment carries it."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
