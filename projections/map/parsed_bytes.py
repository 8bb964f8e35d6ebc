"""Parsed events as bytes in memory that two processes share.

First the arrays of the vectors, stretch after stretch: float32 as recorded, then the unit vectors
in int32. After them everything else as MessagePack, which holds each float to the last bit and is
read straight into envelopes. Both processes are of one program; a log never has these bytes.
A unit vector's -0.0 in float64 comes back as 0.0, which changes no product and no sum.

An envelope is read without its embeddings' base64: nothing needs it once they are decoded.
"""

from collections.abc import Iterable, Iterator
from itertools import accumulate, pairwise
from typing import Final, NamedTuple

import msgspec
import numpy as np
from msgspec.structs import force_setattr

from eventsrc.envelope.ingest import Accepted, Rejected, Vector
from eventsrc.envelope.model import DetId, Envelope, Offset
from eventsrc.envelope.occupancy_map import OccupancyMap
from eventsrc.envelope.system_events import MAP_KEY
from eventsrc.log import Event
from projections.fold.exact import Units
from projections.fold.folded_ids import content_digest

from .parsing import ParsedEvent, parse_events, parse_map


class _Event(msgspec.Struct, array_like=True, gc=False):
    """An event: a valid envelope with the other fields of `Accepted` but its vectors; the bytes of
    a map; the reason of a refusal; or nothing for an event that a fold skips."""

    offset: Offset
    logged_ns: int
    envelope: Envelope | None = None
    det_ids: tuple[DetId, ...] = ()
    digest: bytes = b""
    map: bytes | None = None
    refusal: str | None = None


class _Stretch(msgspec.Struct, array_like=True, gc=False):
    """Events; of their vectors the dimensions and squared norms, and where their arrays begin."""

    events: list[_Event]
    dims: list[int | None]
    norms: list[int | None]
    at: int


_encode: Final = msgspec.msgpack.Encoder().encode
_decode: Final = msgspec.msgpack.Decoder(list[_Stretch]).decode


class Packed(NamedTuple):
    """The position of the part in MessagePack; the arrays precede it."""

    at: int
    length: int


class NoRoom(Exception):
    """The memory is too small for these events."""


def pack(stretches: Iterable[list[Event]], memory: memoryview) -> Packed:
    """Parse the events and write them. Raises NoRoom."""
    packed: list[_Stretch] = []
    at = 0
    for events in stretches:
        parsed = parse_events(events)
        units = [unit for each in parsed for unit in each.units]
        vectors = [
            v for each in parsed if isinstance(each.parsed, Accepted) for v in each.parsed.vectors
        ]
        dims = [None if vector is None else len(vector) for vector in vectors]
        norms = [None if unit is None else unit[2] for unit in units]
        found = [_packed(one, event) for one, event in zip(parsed, events, strict=True)]
        packed.append(_Stretch(found, dims, norms, at))
        at = _write_arrays(vectors, units, memory, at)
    document = _encode(packed)
    if at + len(document) > len(memory):
        raise NoRoom
    memory[at : at + len(document)] = document
    return Packed(at, len(document))


def unpack(packed: Packed, memory: memoryview) -> Iterator[list[ParsedEvent]]:
    """The parsed events that `pack` wrote, in its stretches. Afterwards nothing refers to the
    memory."""
    for stretch in _decode(memory[packed.at : packed.at + packed.length]):
        vectors, units = _read_arrays(stretch.dims, stretch.norms, memory, stretch.at)
        first, events = 0, []
        for event in stretch.events:
            stop = first + len(event.det_ids)
            parsed = _unpacked(event, tuple(vectors[first:stop]))
            events.append(ParsedEvent(event.offset, event.logged_ns, parsed, units[first:stop]))
            first = stop
        yield events


def _write_arrays(
    vectors: list[Vector | None], units: list[Units | None], memory: memoryview, at: int
) -> int:
    """Write the arrays at ``at`` and return the position after them."""
    total = sum(len(vector) for vector in vectors if vector is not None)
    exact_at = at + 4 * total
    end = exact_at + 4 * total
    if end > len(memory):
        raise NoRoom
    if total:
        given = [vector for vector in vectors if vector is not None]
        exact = [unit[1] for unit in units if unit is not None]
        np.concatenate(given, out=np.frombuffer(memory, np.float32, total, at))
        np.concatenate(exact, out=np.frombuffer(memory, np.int32, total, exact_at))
    return end


def _read_arrays(
    dims: list[int | None], norms: list[int | None], memory: memoryview, at: int
) -> tuple[list[Vector | None], list[Units | None]]:
    edges = [0, *accumulate(dim or 0 for dim in dims)]
    total = edges[-1]
    narrow = np.frombuffer(memory, np.float32, total, at).copy()
    exact = np.frombuffer(memory, np.int32, total, at + 4 * total).copy()
    wide = exact.astype(np.float64)
    if dims and dims[0] is not None and dims.count(dims[0]) == len(dims):  # rows are quicker
        shape = len(dims), dims[0]
        rows = zip(wide.reshape(shape), exact.reshape(shape), norms, strict=True)
        return list(narrow.reshape(shape)), list(rows)  # type: ignore[arg-type]
    vectors: list[Vector | None] = []
    units: list[Units | None] = []
    for norm2, (start, stop) in zip(norms, pairwise(edges), strict=True):
        is_given = norm2 is not None
        vectors.append(narrow[start:stop] if is_given else None)
        units.append((wide[start:stop], exact[start:stop], norm2) if norm2 is not None else None)
    return vectors, units


def _packed(event: ParsedEvent, read: Event) -> _Event:
    parsed, offset, logged_ns = event.parsed, event.offset, event.logged_ns
    if isinstance(parsed, Accepted):
        digest = content_digest(parsed)
        for detection in parsed.envelope.detections:
            force_setattr(detection, "embedding", None)
        return _Event(offset, logged_ns, parsed.envelope, parsed.det_ids, digest)
    if read.key == MAP_KEY:
        return _Event(offset, logged_ns, map=read.payload)
    refusal = parsed.reason if isinstance(parsed, Rejected) else None
    return _Event(offset, logged_ns, refusal=refusal)


def _unpacked(
    event: _Event, vectors: tuple[Vector | None, ...]
) -> Accepted | OccupancyMap | Rejected | None:
    if event.envelope is not None:
        return Accepted(event.envelope, event.det_ids, vectors, event.digest)
    if event.map is not None:
        return parse_map(event.map)
    return None if event.refusal is None else Rejected(event.refusal)
