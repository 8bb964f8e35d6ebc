"""Events straight from a chunk, without any index: what a scan found good."""

import os
from collections.abc import Iterator
from functools import partial

from . import _mcap
from ._scan import Scan
from ._schemas import envelope_version
from .event import Event
from .segment import ChunkRef


def read_body(fd: int, chunk: ChunkRef) -> bytes:
    """The body of a chunk that has been checked already."""
    if chunk.body is not None:
        return chunk.body()
    return _mcap.read_chunk(partial(os.pread, fd), chunk.length, chunk.position)


def raw_events(fd: int, scan: Scan, chunk: ChunkRef) -> Iterator[Event]:
    """The events of a chunk of ``scan``."""
    body = read_body(fd, chunk)
    _, channels = _mcap.definitions(body)
    known = {
        channel.id: (channel.topic, envelope_version(channel))
        for channel in (*scan.channels.values(), *channels)
    }
    for id_, sequence, log_ns, stamp_ns, at, stop in _mcap.walk(body):
        key, version = known[id_]
        yield Event(scan.base + sequence, key, log_ns, stamp_ns, body[at:stop], version)
