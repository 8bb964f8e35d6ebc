"""Write a new sealed segment from the good chunks of a damaged one.

Every offset is kept, because checkpoints, maps and people refer to offsets: a lost event is
replaced by a ``mapfold/loss`` event with cause ``rot``. Timestamps of lost events are estimated
from their neighbours: those of the event before, or else of the one after.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from eventsrc.base.errors import LogDamaged, NotALog
from eventsrc.envelope.model import ENVELOPE_VERSION, Offset
from eventsrc.envelope.system_events import LOSS_KEY, Loss

from . import mcap_records as _mcap
from .channels import NO_SCHEMA, is_verbatim, key_channel, schema_of
from .format import SegmentPath
from .mcap_records import Channel, Schema
from .scan import read_body
from .seal import SegmentPlan, seal
from .sealed_segment import SealedFile
from .segment import ActiveFile, ChunkRef, Scan


class EventTimes(NamedTuple):
    """Log time and stamp of an event, int nanoseconds."""

    logged_ns: int
    stamp_ns: int


UNKNOWN_TIMES = EventTimes(0, 0)


def first_and_last_times(body: bytes) -> tuple[EventTimes, EventTimes]:
    """The times of the first and the last event in the body of a good chunk."""
    times = [
        EventTimes(log_ns, stamp_ns) for _, _, log_ns, stamp_ns, _, _ in _mcap.iter_messages(body)
    ]
    return times[0], times[-1]


def adjacent_times(before: SegmentPath | None, after: SegmentPath | None) -> EventTimes:
    """The times of the event before a lost segment, or else of the one after it; zeros if neither
    can be read."""
    for segment, chunk, which in ((before, -1, 1), (after, 0, 0)):
        if segment is None:
            continue
        try:
            file = (SealedFile if segment.sealed else ActiveFile)(segment.path, segment.base)
            if file.chunks:
                return first_and_last_times(file.read_chunk(file.chunks[chunk]))[which]
        except (LogDamaged, NotALog):
            continue
    return UNKNOWN_TIMES


_BATCH = 4096
"""Losses encoded at a time."""
LOST_SCHEMA = "lost"
"""The name of a schema that no readable chunk has."""


@dataclass(slots=True)
class _Definitions:
    """Channels and schemas of the good chunks, and one channel for losses."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)

    def add(self, body: bytes) -> None:
        schemas, channels = _mcap.definitions(body)
        self.schemas.update((schema.id, schema) for schema in schemas)
        self.channels.update((channel.id, channel) for channel in channels)

    def loss_channel(self) -> int:
        for channel in self.channels.values():
            if channel.topic == LOSS_KEY:
                return channel.id
        id_ = max(self.channels, default=0) + 1
        schema = max([*self.schemas, *(c.schema_id for c in self.channels.values())], default=0) + 1
        self.channels[id_] = key_channel(id_, schema, LOSS_KEY, ENVELOPE_VERSION)
        return id_

    def encode(self) -> bytes:
        """All records, schemas first. A lost schema is generated again from its key; that of
        verbatim messages, lost with all chunks that had it, is left empty."""
        for channel in self.channels.values():
            if channel.schema_id in (NO_SCHEMA, *self.schemas):
                continue
            name, encoding, text = LOST_SCHEMA, "", b""
            if not is_verbatim(channel):
                (name, text), encoding = schema_of(channel.topic), "jsonschema"
            self.schemas[channel.schema_id] = Schema(
                id=channel.schema_id, name=name, encoding=encoding, data=text
            )
        return _mcap.encode_all([*self.schemas.values(), *self.channels.values()])


def rebuild_segment(plan: SegmentPlan, source: Path | None, scan: Scan, times: EventTimes) -> str:
    """Seal the good chunks of ``source``, with losses for the gaps; the new file's SHA-256. Losses
    have ``times`` if there is no good chunk to take them from."""
    if source is None:
        return seal(plan, _chunk_bodies(-1, scan, times))
    fd = os.open(source, os.O_RDONLY)
    try:
        return seal(plan, _chunk_bodies(fd, scan, times))
    finally:
        os.close(fd)


def _chunk_bodies(fd: int, scan: Scan, times: EventTimes) -> Iterator[bytes]:
    definitions = _Definitions(dict(scan.channels), dict(scan.schemas))
    for chunk in scan.chunks:
        definitions.add(read_body(fd, chunk))
    loss_channel = definitions.loss_channel() if scan.gaps else 0
    prelude = definitions.encode()
    if scan.chunks:
        times = first_and_last_times(read_body(fd, scan.chunks[0]))[0]
    pieces: list[tuple[int, ChunkRef | int]] = [(c.first, c) for c in scan.chunks]
    pieces += scan.gaps
    for first, rest in sorted(pieces, key=lambda piece: piece[0]):
        if isinstance(rest, ChunkRef):
            body = read_body(fd, rest)
            times = first_and_last_times(body)[1]
            yield prelude + body
            prelude = b""
        else:
            for start in range(first, rest + 1, _BATCH):
                upto = min(start + _BATCH, rest + 1)
                yield prelude + _losses(scan.base, loss_channel, start, upto, times)
                prelude = b""


def _losses(base: Offset, channel: int, first: int, following: int, times: EventTimes) -> bytes:
    parts: list[bytes] = []
    for offset in range(first, following):
        loss = Loss(publisher="log", first=offset, last=offset, count=1, cause="rot")
        payload = loss.model_dump_json().encode()
        head = _mcap.encode_message_head(
            channel, offset - base, times.logged_ns, times.stamp_ns, len(payload)
        )
        parts += (head, payload)
    return b"".join(parts)


def slice_scan(source: Path, scan: Scan, first: Offset, end: Offset) -> Scan:
    """The part of a scan of ``source`` from offset ``first`` to before ``end``, as a segment of its
    own that ends with the last good event."""
    rest = Scan(first, scan.log_id, next_offset=first, channels=scan.channels, schemas=scan.schemas)
    for chunk in scan.chunks:
        start, stop = max(first, chunk.first), min(end, chunk.following)
        if start < stop:
            body = partial(_slice_chunk, source, chunk, scan.base, range(start, stop), first)
            rest.add_chunk(ChunkRef(0, chunk.length, start, stop, body=body))
    return rest


def _slice_chunk(
    source: Path, chunk: ChunkRef, base: Offset, offsets: range, new_base: Offset
) -> bytes:
    """The messages of a chunk with these offsets, renumbered from ``new_base``."""
    fd = os.open(source, os.O_RDONLY)
    try:
        body = read_body(fd, chunk)
    finally:
        os.close(fd)
    schemas, channels = _mcap.definitions(body)
    parts = [_mcap.encode_all([*schemas, *channels])]
    for channel, sequence, log_ns, stamp_ns, at, end in _mcap.iter_messages(body):
        offset = base + sequence
        if offset in offsets:
            head = _mcap.encode_message_head(channel, offset - new_base, log_ns, stamp_ns, end - at)
            parts += (head, body[at:end])
    return b"".join(parts)
