"""What goes into each chunk of a sealed segment.

The chunks of a growing segment are as large as its commits happened to be. Sealed ones are of about
`CHUNK_BYTES`: what one flipped bit can cost, and what one event takes to read. Small bodies are
joined, large ones parted, and every part is led by the channels it needs.
"""

import struct
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from . import _mcap
from ._mcap import FRAME, MAX_MESSAGES, MESSAGE, BadRecord, Opcode

CHUNK_BYTES = 1024 * 1024


@dataclass(frozen=True, slots=True)
class Part:
    """The body of one chunk and, parallel to one another, what its messages' heads say.

    ``positions`` are where in the body they start; ``definitions`` are the records of schemas and
    channels that come with this part and did not come with one before.
    """

    body: bytes
    channels: Sequence[int]
    log_ns: Sequence[int]
    stamp_ns: Sequence[int]
    positions: Sequence[int]
    definitions: bytes

    def entries(self) -> dict[int, list[int]]:
        """By channel: log time and position of each message, by turns, as an index has them."""
        entries: dict[int, list[int]] = {channel: [] for channel in self.channels}
        for channel, log_ns, position in zip(
            self.channels, self.log_ns, self.positions, strict=True
        ):
            entries[channel] += (log_ns, position)
        return entries


def parts_of(bodies: Iterable[bytes]) -> Iterator[Part]:
    """Bodies of chunks in offset order, joined or parted to about `CHUNK_BYTES`."""
    waiting: list[bytes] = []
    size = 0
    for body in bodies:
        waiting.append(body)
        size += len(body)
        if size >= CHUNK_BYTES:
            yield from _parted(b"".join(waiting))
            waiting, size = [], 0
    if waiting:
        yield from _parted(b"".join(waiting))


def _parted(body: bytes) -> Iterator[Part]:
    """One part, or several of about the same size where it is two chunks large or more."""
    rows, starts, others = _layout(body)
    _, _, channels, _, log_ns, stamp_ns = zip(*rows, strict=True)
    definitions = b"".join(body[start:end] for start, end in others)
    lead = b""
    edges = _edges(len(body), starts)
    for first, last in pairwise(edges):
        at = starts[first] if first else 0
        end = starts[last] if last < len(starts) else len(body)
        shift = len(lead) - at
        yield Part(
            lead + body[at:end] if len(edges) > 2 else body,
            channels[first:last],
            log_ns[first:last],
            stamp_ns[first:last],
            [start + shift for start in starts[first:last]],
            b"" if first else definitions,
        )
        lead = lead or _mcap.encode_all(_mcap.definitions(definitions)[1])


def _edges(size: int, starts: list[int]) -> list[int]:
    """Indexes of the messages that the parts begin with, and how many messages there are."""
    count = max(1, size // CHUNK_BYTES)
    inner = {bisect_left(starts, size * part // count) for part in range(1, count)}
    return sorted({0, len(starts)} | inner)


def _layout(body: bytes) -> tuple[list[tuple[int, ...]], list[int], list[tuple[int, int]]]:
    """Heads and starts of all messages, and start and end of everything else."""
    at, size, unpack, message = 0, len(body), MESSAGE.unpack_from, int(Opcode.MESSAGE)
    rows: list[tuple[int, ...]] = []
    starts: list[int] = []
    others: list[tuple[int, int]] = []
    try:
        while at < size:
            if body[at] == message:
                row = unpack(body, at)
                rows.append(row)
                if len(rows) > MAX_MESSAGES:
                    raise BadRecord(f"a chunk of more than {MAX_MESSAGES:,} messages")
                starts.append(at)
                at += FRAME.size + row[1]
            else:
                start, at = at, at + FRAME.size + FRAME.unpack_from(body, at)[1]
                others.append((start, at))
    except struct.error:
        raise BadRecord("a record is cut short in a chunk") from None
    if at != size:
        raise BadRecord("a record does not fit its chunk")
    return rows, starts, others
