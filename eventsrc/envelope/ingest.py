"""Validate the bytes of an envelope: `Accepted`, or `Rejected` with the reason.

No I/O. The recorder, the importer and the fold all use it, so a log holds nothing under a robot's
key that the fold cannot read. The caller writes a rejected payload, with its bytes, to the
``mapfold/rejected`` channel. The reasons are part of those events.
"""

import binascii
import codecs
import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from typing import Any, Final

import msgspec
import numpy as np
import pybase64
from numpy.typing import NDArray
from pydantic import ValidationError
from pydantic_core import from_json

from eventsrc.base.text import visible

from .model import (
    Detection,
    DetId,
    Envelope,
    KeyframeId,
    RunId,
    contains_non_finite,
    default_det_id,
    describe_error,
)
from .readers import NonFinite, read_checked, read_plain

DEFAULT_MAX_PAYLOAD_BYTES = 16 * 1024 * 1024
MAX_PAYLOAD_BYTES = 2 * DEFAULT_MAX_PAYLOAD_BYTES
"""Bound of ``max_bytes``. As base64 in a rejection such a payload fits the 96 MiB of an event."""
MAX_JSON_VALUES = 500_000
"""Bound of the values in one payload, counted as commas and opening brackets: parsing JSON costs
some hundred bytes and a microsecond a value, however short the value."""
_UNCOUNTED_BYTES: Final = 64 * 1024
"""In payloads up to this size values are not counted."""
_EMPTY_LIST: Final = (
    "an empty list: of the older form without an envelope, a picture with no detections, which "
    "names no run, keyframe, time or pose"
)
_BYTE_ORDER_MARKS: Final = (codecs.BOM_UTF8, codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_MAX_SHOWN: Final = 80
"""Characters of a value that a reason shows."""

Vector = NDArray[np.float32]
_FLOAT32 = np.dtype("<f4")


class Accepted(msgspec.Struct, frozen=True, gc=False):
    """A valid envelope with its vectors decoded.

    ``det_ids`` and ``vectors`` run parallel to ``envelope.detections``. A vector is float32 of
    shape (embedding_dim,), finite, not zero and *not* normalised; None where the detection
    has none. ``digest`` is the fold's digest of the content, where another process has made it.
    """

    envelope: Envelope
    det_ids: tuple[DetId, ...]
    vectors: tuple[Vector | None, ...]
    digest: bytes | None = None


class Rejected(msgspec.Struct, frozen=True, gc=False):
    """A payload that is not an envelope: ``reason`` names the field, its value and the rule."""

    reason: str


class CheckedEnvelope(msgspec.Struct, frozen=True, gc=False):
    """Run, keyframe and time of a valid envelope, for callers that keep its bytes."""

    run_id: RunId
    keyframe_id: KeyframeId
    stamp_ns: int
    numbered: bool | None = None
    """Whether all classes are numbers; None without detections."""

    @classmethod
    def of(cls, envelope: Envelope) -> "CheckedEnvelope":
        """Run, keyframe and time of ``envelope``."""
        detections = envelope.detections
        numbered = all(d.class_name.isdecimal() for d in detections) if detections else None
        return cls(envelope.run_id, envelope.keyframe_id, envelope.stamp_ns, numbered)


class _RejectionError(Exception):
    """A reason for rejection, caught within this module."""


def ingest(payload: bytes, *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES) -> Accepted | Rejected:
    """Validate one envelope and decode its vectors. Never raises for bad input."""
    return ingest_all((payload,), max_bytes=max_bytes)[0]


def ingest_all(
    payloads: Sequence[bytes], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Accepted | Rejected]:
    """`ingest` each payload; faster than one by one, because their vectors are decoded together."""
    read = [check_cost(p, max_bytes) or read_plain(p) or _read_checked(p) for p in payloads]
    rows = _decode_uniform(_detections(read))
    if rows is None:
        return [_accept(result, None) for result in read]
    vectors = iter(list(rows))
    return [r if isinstance(r, Rejected) else _accept(r, vectors) for r in read]


def check_all(
    payloads: Sequence[bytes], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[CheckedEnvelope | Rejected]:
    """Validate each payload as `ingest` does, but return no vectors; faster, for callers that only
    keep the bytes."""
    plain = [read_plain(p) if check_cost(p, max_bytes) is None else None for p in payloads]
    if not _have_vectors([d for e in plain if e is not None for d in e.detections]):
        plain = [e if e is not None and _have_vectors(e.detections) else None for e in plain]
    return [
        _check(payload, max_bytes) if known is None else CheckedEnvelope.of(known)
        for payload, known in zip(payloads, plain, strict=True)
    ]


def _have_vectors(detections: Sequence[Detection]) -> bool:
    """Whether all given embeddings are valid; those of one dimension are decoded together."""
    if _decode_uniform(detections) is not None:  # the usual case
        return True
    by_dim: defaultdict[int | None, list[Detection]] = defaultdict(list)
    for detection in detections:
        if detection.embedding is not None:
            by_dim[detection.embedding_dim].append(detection)
    return all(_decode_uniform(each) is not None for each in by_dim.values())


def _check(payload: bytes, max_bytes: int) -> CheckedEnvelope | Rejected:
    """`check_all` of a payload that `read_plain` does not read, or with a faulty vector."""
    result = _accept(check_cost(payload, max_bytes) or _read_checked(payload), None)
    return result if isinstance(result, Rejected) else CheckedEnvelope.of(result.envelope)


def _detections(read: Sequence[Envelope | Rejected]) -> list[Detection]:
    return [d for result in read if isinstance(result, Envelope) for d in result.detections]


def check_cost(payload: bytes, max_bytes: int) -> Rejected | None:
    """The rejection of a payload that would cost too much to parse, found without parsing it."""
    if len(payload) > max_bytes:
        return Rejected(f"payload of {len(payload)} bytes is over the limit of {max_bytes}")
    if len(payload) > _UNCOUNTED_BYTES:
        values = sum(map(payload.count, (b",", b"[", b"{")))
        if values > MAX_JSON_VALUES:
            return Rejected(
                f"payload of {values:,} commas and opening brackets, more than {MAX_JSON_VALUES:,}"
            )
    return None


def _read_checked(payload: bytes) -> Envelope | Rejected:
    try:
        return read_checked(payload)
    except ValidationError as error:
        return Rejected(_error_reason(error, payload))
    except NonFinite:
        return Rejected(_non_finite_reason(from_json(payload)))
    except RecursionError:  # nested deeper than the parser's limit
        return Rejected("not JSON that can be read: nested too deeply")


def _accept(result: Envelope | Rejected, vectors: Iterator[Vector] | None) -> Accepted | Rejected:
    """A parsed envelope with its ids and vectors. ``vectors`` yields the vectors if they have been
    decoded already."""
    if isinstance(result, Rejected):
        return result
    own = None if vectors is None else tuple(islice(vectors, len(result.detections)))
    try:
        return Accepted(result, _det_ids(result), _decode_vectors(result) if own is None else own)
    except _RejectionError as rejection:
        return Rejected(str(rejection))


def _error_reason(error: ValidationError, payload: bytes) -> str:
    """One line for the first error, and the number of further ones before pydantic stopped.

    Pydantic would copy the wrong value into each error, the whole envelope for every missing field;
    so the one value that is shown is looked up here instead.
    """
    details = error.errors(include_url=False, include_context=False, include_input=False)
    first = details[0]
    if first["type"] == "json_invalid":
        if payload.startswith(_BYTE_ORDER_MARKS):
            return "not JSON: begins with a byte order mark; send UTF-8 without one"
        return f"not JSON: {first['msg'].removeprefix('Invalid JSON: ')}"
    if first["type"] == "model_type" and not first["loc"]:
        if from_json(payload) == []:
            return _EMPTY_LIST
        return f"not a JSON object but {type(from_json(payload)).__name__}"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    path = _field_path(*first["loc"])
    if first["type"] == "missing":
        return f"{path}: required field is missing{more}"
    if not first["loc"]:
        return f"{describe_error(first)}{more}"
    value = from_json(payload)
    for part in first["loc"]:
        value = value[part]
    first["input"] = value
    return f"{path}: {describe_error(first)} (got {abbreviate(value)}){more}"


def _non_finite_reason(document: Any) -> str:
    """The reason for NaN or infinity in an unknown field; there may be further errors."""
    of_envelope = (((name,), value) for name, value in document.items() if name != "detections")
    detections = document.get("detections")
    of_detections = (
        (("detections", index, name), value)
        for index, detection in enumerate(detections if isinstance(detections, list) else ())
        if isinstance(detection, dict)
        for name, value in detection.items()
    )
    fields: Iterator[tuple[tuple[str | int, ...], Any]] = chain(of_envelope, of_detections)
    path, value = next(field for field in fields if contains_non_finite(field[1]))
    return f"{_field_path(*path)}: holds NaN or infinity (got {abbreviate(value)})"


def _field_path(*parts: str | int) -> str:
    """``detections.3.bbox``, bounded and printable whatever the field's name."""
    return visible(".".join(str(part)[:_MAX_SHOWN] for part in parts))


def abbreviate(value: Any) -> str:
    """The first characters of ``repr(value)``, without the cost of the whole."""
    text = _repr_start(value, _MAX_SHOWN)
    return text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "..."


def _repr_start(value: Any, room: int) -> str:
    """``repr(value)``, or a text with the same first ``room`` characters."""
    if isinstance(value, str):
        return repr(value[: room + 1])
    if not isinstance(value, list | dict):
        return repr(value)
    text = ""
    for item in value.items() if isinstance(value, dict) else value:
        if len(text) > room:
            break
        text += ", " if text else ""
        if isinstance(item, tuple):  # a member of an object
            text += f"{_repr_start(item[0], room)}: {_repr_start(item[1], room - len(text))}"
        else:
            text += _repr_start(item, room - len(text))
    return f"{{{text}}}" if isinstance(value, dict) else f"[{text}]"


def _det_ids(envelope: Envelope) -> tuple[DetId, ...]:
    if not envelope.detections:
        return ()
    given = [detection.det_id for detection in envelope.detections]
    start = default_det_id(envelope.run_id, envelope.keyframe_id, 0)[:-1]
    if not any(given):
        return tuple([f"{start}{n}" for n in range(len(given))])  # type: ignore[misc]
    ids = [
        DetId(f"{start}{index}") if det_id is None else det_id for index, det_id in enumerate(given)
    ]
    if len(set(ids)) == len(ids):
        return tuple(ids)
    seen: set[DetId] = set()
    for index, det_id in enumerate(ids):
        if det_id in seen:
            raise _RejectionError(
                f"detections.{index}.det_id: {det_id!r} stands twice in one envelope"
            )
        seen.add(det_id)
    return tuple(ids)


def _decode_vectors(envelope: Envelope) -> tuple[Vector | None, ...]:
    detections = envelope.detections
    rows = _decode_uniform(detections)
    if rows is not None:
        return tuple(rows)
    return tuple(
        None if d.embedding is None else _decode_vector(index, d)
        for index, d in enumerate(detections)
    )


def _decode_uniform(detections: Sequence[Detection]) -> Vector | None:
    """All vectors at once, shape (len(detections), dim), if they are valid and of one dimension, as
    is usual; None if each must be decoded on its own."""
    try:
        raws = [pybase64.b64decode(d.embedding, None, True) for d in detections]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    dims = {d.embedding_dim for d in detections}
    sizes = {*map(len, raws)}
    if None in dims or len(dims) != 1 or sizes != {4 * dim for dim in dims if dim}:
        return None
    rows = np.frombuffer(b"".join(raws), _FLOAT32).reshape(len(raws), -1)
    # A squared norm of 0, infinity or NaN means that the vector may be zero or not finite.
    for norm2 in np.einsum("ij,ij->i", rows, rows).tolist():
        if not 0.0 < norm2 < math.inf:
            return None
    return rows


def _decode_vector(index: int, detection: Detection) -> Vector:
    place = f"detections.{index}.embedding"
    raw = _decode_base64(place, detection.embedding or "")
    dim = detection.embedding_dim
    if dim is None:
        raise _RejectionError(f"detections.{index}.embedding_dim: required beside an embedding")
    if len(raw) != 4 * dim:
        raise _RejectionError(
            f"{place}: {len(raw)} bytes do not match embedding_dim {dim}, which takes {4 * dim}"
        )
    vector = np.frombuffer(raw, dtype="<f4")
    largest = float(np.abs(vector).max())
    if not np.isfinite(largest):
        raise _RejectionError(f"{place}: holds NaN or infinity")
    if largest == 0.0:
        raise _RejectionError(f"{place}: is the zero vector, which has no direction")
    return vector


def _decode_base64(place: str, text: str) -> bytes:
    try:
        return pybase64.b64decode(text, None, True)
    except ValueError:
        raise _RejectionError(f"{place}: not base64: {_base64_error(text)}") from None


def _base64_error(text: str) -> str:
    """The fault in ``text``, by `binascii`. Not used to validate, because not every version of it
    refuses excess padding."""
    try:
        binascii.a2b_base64(text, strict_mode=True)
    except ValueError as error:
        return str(error)
    return "Excess padding"
