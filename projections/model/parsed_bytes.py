"""Parsed events as bytes in memory that two processes share.

First the arrays of the vectors, stretch after stretch: float32 as recorded, then the unit vectors
in int32. After them everything else in the format of `marshal`, which Python reads several times
as quickly as a pickle, and which holds each float to the last bit. Both processes are of one
program and of one Python, so nothing is checked when it is read; a log never has these bytes.
A unit vector's -0.0 in float64 comes back as 0.0, which changes no product and no sum.

An envelope is read without its embeddings' base64: nothing needs it once they are decoded.
"""

import marshal
from collections.abc import Iterable, Iterator
from itertools import accumulate, pairwise
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import msgspec
import numpy as np
from pydantic import BaseModel

from eventsrc.envelope import Detection, Envelope, EnvelopeCamera, Offset
from eventsrc.ingest import Accepted, Rejected, Vector
from eventsrc.log import Event
from eventsrc.system_events import MAP_KEY
from projections.exact import Units
from projections.reducers.folded_ids import content_digest

from .parsing import ParsedEvent, parse_events, parse_map

_Record: TypeAlias = tuple[Any, ...]
"""Of an event: offset, logged_ns, and what was parsed, see `_record`."""
_Model = TypeVar("_Model", bound=BaseModel)


class Packed(NamedTuple):
    """Where the marshalled part is; the arrays are before it."""

    at: int
    length: int


class NoRoom(Exception):
    """The memory is too small for these events."""


def pack(stretches: Iterable[list[Event]], memory: memoryview) -> Packed:
    """Parse the events and write them. Raises NoRoom."""
    documents, at = [], 0
    for events in stretches:
        parsed = parse_events(events, fields_only=True)
        units = [unit for each in parsed for unit in each.units]
        vectors = [
            v for each in parsed if isinstance(each.parsed, Accepted) for v in each.parsed.vectors
        ]
        dims = [None if vector is None else len(vector) for vector in vectors]
        norms = [None if unit is None else unit[2] for unit in units]
        records = [_record(one, event) for one, event in zip(parsed, events, strict=True)]
        documents.append((records, dims, norms, at))
        at = _write_arrays(vectors, units, memory, at)
    document = marshal.dumps(documents)
    if at + len(document) > len(memory):
        raise NoRoom
    memory[at : at + len(document)] = document
    return Packed(at, len(document))


def unpack(packed: Packed, memory: memoryview) -> Iterator[list[ParsedEvent]]:
    """What `pack` was given, parsed, in its stretches. Nothing refers to the memory afterwards."""
    documents = marshal.loads(memory[packed.at : packed.at + packed.length])  # noqa: S302 - ours
    for records, dims, norms, at in documents:
        vectors, units = _read_arrays(dims, norms, memory, at)
        first, parsed = 0, []
        for record in records:
            event = _parsed(record, first, vectors, units)
            first += len(event.units)
            parsed.append(event)
        yield parsed


def _write_arrays(
    vectors: list[Vector | None], units: list[Units | None], memory: memoryview, at: int
) -> int:
    """Write the arrays at ``at``; the place after them."""
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


def _record(event: ParsedEvent, read: Event) -> _Record:
    """Nothing more for an event that a fold passes over, bytes for one on `MAP_KEY`, text for a
    refusal; for an envelope its fields, det_ids and digest."""
    parsed = event.parsed
    if isinstance(parsed, Accepted):
        envelope = _fields(parsed.envelope)
        detections = [_fields(detection) for detection in parsed.envelope.detections]
        for detection in detections:
            detection["embedding"] = None
        envelope["detections"] = detections
        if parsed.envelope.camera is not None:
            envelope["camera"] = _fields(parsed.envelope.camera)
        digest = content_digest(parsed)
        return event.offset, event.logged_ns, envelope, parsed.det_ids, digest
    if read.key == MAP_KEY:
        return event.offset, event.logged_ns, read.payload
    if isinstance(parsed, Rejected):
        return event.offset, event.logged_ns, parsed.reason
    return event.offset, event.logged_ns


def _parsed(
    record: _Record, first: int, vectors: list[Vector | None], units: list[Units | None]
) -> ParsedEvent:
    """The event of a record; its vectors begin with the number ``first``."""
    offset, logged_ns = Offset(record[0]), record[1]
    if len(record) == 2:
        return ParsedEvent(offset, logged_ns, None, [])
    if isinstance(record[2], bytes):
        return ParsedEvent(offset, logged_ns, parse_map(record[2]), [])
    if isinstance(record[2], str):
        return ParsedEvent(offset, logged_ns, Rejected(record[2]), [])
    _, _, fields, det_ids, digest = record
    fields["detections"] = tuple([_model(Detection, each) for each in fields["detections"]])
    if fields["camera"] is not None:
        fields["camera"] = _model(EnvelopeCamera, fields["camera"])
    stop = first + len(det_ids)
    own = tuple(vectors[first:stop])
    accepted = Accepted(_model(Envelope, fields), det_ids, own, digest)
    return ParsedEvent(offset, logged_ns, accepted, units[first:stop])


def _fields(model: BaseModel | msgspec.Struct) -> dict[str, Any]:
    return (
        msgspec.structs.asdict(model) if isinstance(model, msgspec.Struct) else {**model.__dict__}
    )


_set: Final = object.__setattr__
_NO_EXTRA: Final[dict[str, Any]] = {}
_SET: Final = {model: set(model.model_fields) for model in (Envelope, Detection, EnvelopeCamera)}


def _model(model: type[_Model], fields: dict[str, Any]) -> _Model:
    """A model with all its ``fields``, which were validated before: `model_construct`, but four
    times as fast. Frozen models may share what they have besides; a copy of one copies it."""
    made = model.__new__(model)
    _set(made, "__dict__", fields)
    _set(made, "__pydantic_fields_set__", _SET[model])  # type: ignore[index]
    _set(made, "__pydantic_extra__", _NO_EXTRA)
    _set(made, "__pydantic_private__", None)
    return made
