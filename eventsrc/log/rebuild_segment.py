"""A new sealed segment from what a scan found good, every offset accounted for.

An event that is gone leaves a ``mapfold/loss`` event at its offset, cause ``rot``: offsets are what
checkpoints, maps and people point at, so none may move, and every reader of the log sees a loss
that is in it. Timestamps of lost events are estimated from their neighbours: those of the event
before, or else of the one behind; the time of the recovery says nothing about them.
"""

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from eventsrc.envelope import ENVELOPE_VERSION, Offset
from eventsrc.errors import LogDamaged, NotALog
from eventsrc.system_events import LOSS_KEY, Loss

from . import mcap_records as _mcap
from .active_file import ActiveFile
from .format import SegmentPath, key_channel, schema_of
from .mcap_records import Channel, Schema
from .scan import Scan, read_body
from .seal import SegmentPlan, seal
from .sealed_segment import SealedFile
from .segment import ChunkRef


class Moment(NamedTuple):
    """The times of an event, int nanoseconds."""

    logged_ns: int
    stamp_ns: int


UNKNOWN = Moment(0, 0)


def moments(body: bytes) -> tuple[Moment, Moment]:
    """Those of the first and of the last event in the body of a good chunk."""
    times = [Moment(log_ns, stamp_ns) for _, _, log_ns, stamp_ns, _, _ in _mcap.walk(body)]
    return times[0], times[-1]


def moment_between(before: SegmentPath | None, behind: SegmentPath | None) -> Moment:
    """The time of the event before a lost segment, else of the one behind it, if either can be
    read."""
    for segment, chunk, which in ((before, -1, 1), (behind, 0, 0)):
        if segment is None:
            continue
        try:
            file = (SealedFile if segment.sealed else ActiveFile)(segment.path, segment.base)
            if file.chunks:
                return moments(file.read_chunk(file.chunks[chunk]))[which]
        except (LogDamaged, NotALog):
            continue
    return UNKNOWN


_BATCH = 4096


@dataclass(slots=True)
class _Definitions:
    """The channels of the good chunks, their schemas, and one channel for losses."""

    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)

    def learn(self, body: bytes) -> None:
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
        """All of them, schemas first. A schema that is gone is made again from its key."""
        for channel in self.channels.values():
            if channel.schema_id not in self.schemas:
                name, text = schema_of(channel.topic)
                self.schemas[channel.schema_id] = Schema(
                    id=channel.schema_id, name=name, encoding="jsonschema", data=text
                )
        return _mcap.encode_all([*self.schemas.values(), *self.channels.values()])


def rebuild(plan: SegmentPlan, source: Path | None, scan: Scan, nearby: Moment) -> str:
    """Seal the good chunks of ``source`` and losses for the gaps; the new file's SHA-256. The
    losses are dated ``nearby`` where there is no good chunk to go by."""
    if source is None:
        return seal(plan, _bodies(-1, scan, nearby))
    fd = os.open(source, os.O_RDONLY)
    try:
        return seal(plan, _bodies(fd, scan, nearby))
    finally:
        os.close(fd)


def _bodies(fd: int, scan: Scan, nearby: Moment) -> Iterator[bytes]:
    definitions = _Definitions(dict(scan.channels))
    for chunk in scan.chunks:
        definitions.learn(read_body(fd, chunk))
    loss_channel = definitions.loss_channel() if scan.gaps else 0
    prelude = definitions.encode()
    if scan.chunks:
        nearby = moments(read_body(fd, scan.chunks[0]))[0]
    pieces: list[tuple[int, ChunkRef | int]] = [(c.first, c) for c in scan.chunks]
    pieces += scan.gaps
    for first, rest in sorted(pieces, key=lambda piece: piece[0]):
        if isinstance(rest, ChunkRef):
            body = read_body(fd, rest)
            nearby = moments(body)[1]
            yield prelude + body
            prelude = b""
        else:
            for start in range(first, rest + 1, _BATCH):
                upto = min(start + _BATCH, rest + 1)
                yield prelude + _losses(scan.base, loss_channel, start, upto, nearby)
                prelude = b""


def _losses(base: Offset, channel: int, first: int, following: int, when: Moment) -> bytes:
    parts: list[bytes] = []
    for offset in range(first, following):
        loss = Loss(publisher="log", first=offset, last=offset, count=1, cause="rot")
        payload = loss.model_dump_json().encode()
        head = _mcap.encode_message_head(
            channel, offset - base, when.logged_ns, when.stamp_ns, len(payload)
        )
        parts += (head, payload)
    return b"".join(parts)


def trimmed(source: Path, scan: Scan, first: Offset, end: Offset) -> Scan:
    """What ``scan`` found in ``source`` from offset ``first`` to before ``end``, as a segment of
    its own; offsets that are missing at its end are left out of it."""
    rest = Scan(first, scan.log_id, next_offset=first, channels=scan.channels)
    for chunk in scan.chunks:
        start, stop = max(first, chunk.first), min(end, chunk.following)
        if start < stop:
            body = partial(_cut_out, source, chunk, scan.base, range(start, stop), first)
            rest.take(ChunkRef(0, chunk.length, start, stop, body=body))
    return rest


def _cut_out(
    source: Path, chunk: ChunkRef, base: Offset, offsets: range, new_base: Offset
) -> bytes:
    """The messages of a chunk that have these offsets, counted from another base."""
    fd = os.open(source, os.O_RDONLY)
    try:
        body = read_body(fd, chunk)
    finally:
        os.close(fd)
    schemas, channels = _mcap.definitions(body)
    parts = [_mcap.encode_all([*schemas, *channels])]
    for channel, sequence, log_ns, stamp_ns, at, end in _mcap.walk(body):
        offset = base + sequence
        if offset in offsets:
            head = _mcap.encode_message_head(channel, offset - new_base, log_ns, stamp_ns, end - at)
            parts += (head, body[at:end])
    return b"".join(parts)
