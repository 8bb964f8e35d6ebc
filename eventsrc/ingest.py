"""From bytes to Accepted or Rejected: what is refused at the door, and why (DESIGN section 3).

No I/O. The same function guards the recorder, the importer and the fold, so a log holds nothing
under a robot's key that the fold cannot read. A refusal keeps the bytes; its caller writes them to
the ``mapfold/rejected`` channel.
"""

import binascii
import math
from collections.abc import Callable, Iterator, Sequence
from itertools import chain, islice
from typing import Any, Final

import msgspec
import numpy as np
import pybase64
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from pydantic_core import from_json

from .envelope import Detection, DetId, Envelope, NotFinite, default_det_id, fault, holds_not_finite
from .text import visible

DEFAULT_MAX_PAYLOAD_BYTES = 16 * 1024 * 1024
MAX_PAYLOAD_BYTES = 2 * DEFAULT_MAX_PAYLOAD_BYTES
"""Of what may be asked for: a log keeps events of up to 96 MiB, and what is rejected as base64."""
MAX_MARKS = 500_000
"""Bound of the commas and opening brackets in one payload, as many as it has values: reading JSON
costs some hundred bytes and a microsecond a value, however short the value."""
_FEW_MARKS_BYTES: Final = 64 * 1024
"""Payloads up to here are not counted: they cannot cost much."""
_QUOTED: Final = 80
"""How many characters of a value a reason shows."""

Vector = NDArray[np.float32]
_FLOAT32 = np.dtype("<f4")
_validate_json: Callable[[bytes], Envelope] = TypeAdapter(Envelope).validator.validate_json
"""``Envelope.model_validate_json`` without the layer of Python around it, a twentieth of it."""


class Accepted(msgspec.Struct, frozen=True, gc=False):
    """A valid envelope with its vectors decoded.

    ``det_ids`` and ``vectors`` run parallel to ``envelope.detections``. A vector is float32 of
    shape (embedding_dim,), finite, not zero and *not* normalised; None where the detection
    has none.
    """

    envelope: Envelope
    det_ids: tuple[DetId, ...]
    vectors: tuple[Vector | None, ...]


class Rejected(msgspec.Struct, frozen=True, gc=False):
    """A payload that is not an envelope: ``reason`` names the field, its value and the rule."""

    reason: str


class _RefusalError(Exception):
    """Inside this module only: carries a reason up to `ingest`."""


def ingest(payload: bytes, *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES) -> Accepted | Rejected:
    """Read one envelope. Never raises for bad input; it says Rejected and why."""
    return ingest_all((payload,), max_bytes=max_bytes)[0]


def ingest_all(
    payloads: Sequence[bytes], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Accepted | Rejected]:
    """`ingest` of each, none dependent on another. Decoding their vectors together saves time."""
    read = [_read(payload, max_bytes) for payload in payloads]
    rows = _rows_of_one_kind(_detections(read))
    if rows is None:
        return [_admit(said, None) for said in read]
    coming = iter(list(rows))
    return [_admit(said, coming) for said in read]


def check_all(
    payloads: Sequence[bytes], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Envelope | Rejected]:
    """What `ingest_all` says to each, without its vectors and ids: for who only keeps the bytes."""
    read = [_read(payload, max_bytes) for payload in payloads]
    if _rows_of_one_kind(_detections(read)) is not None:
        return [_check_det_ids(said) for said in read]
    admitted = [_admit(said, None) for said in read]
    return [said if isinstance(said, Rejected) else said.envelope for said in admitted]


def _detections(read: Sequence[Envelope | Rejected]) -> list[Detection]:
    return [d for said in read if isinstance(said, Envelope) for d in said.detections]


def excess(payload: bytes, max_bytes: int) -> Rejected | None:
    """The refusal of a payload that would cost too much to read, told before it is read."""
    if len(payload) > max_bytes:
        return Rejected(f"payload of {len(payload)} bytes is over the limit of {max_bytes}")
    if len(payload) > _FEW_MARKS_BYTES:
        marks = sum(map(payload.count, (b",", b"[", b"{")))
        if marks > MAX_MARKS:
            return Rejected(
                f"payload of {marks:,} commas and opening brackets, more than {MAX_MARKS:,}"
            )
    return None


def _read(payload: bytes, max_bytes: int) -> Envelope | Rejected:
    refused = excess(payload, max_bytes)
    if refused is not None:
        return refused
    try:
        return _validate_json(payload)
    except ValidationError as error:
        return Rejected(_first_error(error, payload))
    except NotFinite:
        return Rejected(_not_finite(from_json(payload)))
    except RecursionError:  # nesting deeper than the parser follows
        return Rejected("not JSON that can be read: nested too deeply")


def _admit(said: Envelope | Rejected, vectors: Iterator[Vector] | None) -> Accepted | Rejected:
    """The last steps, which look at several fields; ``vectors`` are those to come, if decoded."""
    if isinstance(said, Rejected):
        return said
    own = None if vectors is None else tuple(islice(vectors, len(said.detections)))
    try:
        return Accepted(said, _det_ids(said), _vectors(said) if own is None else own)
    except _RefusalError as refusal:
        return Rejected(str(refusal))


def _first_error(error: ValidationError, payload: bytes) -> str:
    """One line for the first thing that is wrong, and how many more pydantic met before it stopped.

    Pydantic would give the wrong value with each error, the whole envelope for every field that is
    missing in it; so the one that is shown is looked up instead.
    """
    details = error.errors(include_url=False, include_context=False, include_input=False)
    first = details[0]
    if first["type"] == "json_invalid":
        return f"not JSON: {first['msg'].removeprefix('Invalid JSON: ')}"
    if first["type"] == "model_type" and not first["loc"]:
        return f"not a JSON object but {type(from_json(payload)).__name__}"
    more = f" (and {len(details) - 1} more)" if len(details) > 1 else ""
    place = _place(*first["loc"])
    if first["type"] == "missing":
        return f"{place}: required field is missing{more}"
    if not first["loc"]:
        return f"{fault(first)}{more}"
    value = from_json(payload)
    for part in first["loc"]:
        value = value[part]
    first["input"] = value
    return f"{place}: {fault(first)} (got {quoted(value)}){more}"


def _not_finite(document: Any) -> str:
    """The reason for an object with NaN or infinity in a field that an envelope does not know.
    There may be more that is wrong with it."""
    of_envelope = (((name,), value) for name, value in document.items() if name != "detections")
    detections = document.get("detections")
    of_detections = (
        (("detections", index, name), value)
        for index, detection in enumerate(detections if isinstance(detections, list) else ())
        if isinstance(detection, dict)
        for name, value in detection.items()
    )
    fields: Iterator[tuple[tuple[str | int, ...], Any]] = chain(of_envelope, of_detections)
    place, value = next(field for field in fields if holds_not_finite(field[1]))
    return f"{_place(*place)}: holds NaN or infinity (got {quoted(value)})"


def _place(*parts: str | int) -> str:
    """``detections.3.bbox``, however long or odd a field's name is."""
    return visible(".".join(str(part)[:_QUOTED] for part in parts))


def quoted(value: Any) -> str:
    """The beginning of a JSON value as Python writes it, at the cost of no more than that."""
    text = _beginning(value, _QUOTED)
    return text if len(text) <= _QUOTED else text[: _QUOTED - 3] + "..."


def _beginning(value: Any, room: int) -> str:
    """``repr(value)``, of which only the first ``room`` characters count."""
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
            text += f"{_beginning(item[0], room)}: {_beginning(item[1], room - len(text))}"
        else:
            text += _beginning(item, room - len(text))
    return f"{{{text}}}" if isinstance(value, dict) else f"[{text}]"


def _check_det_ids(said: Envelope | Rejected) -> Envelope | Rejected:
    if isinstance(said, Rejected):
        return said
    for detection in said.detections:
        if detection.det_id is not None:  # the ids that mapfold gives differ from one another
            try:
                _det_ids(said)
            except _RefusalError as refusal:
                return Rejected(str(refusal))
            break
    return said


def _det_ids(envelope: Envelope) -> tuple[DetId, ...]:
    ids = [
        default_det_id(envelope.run_id, envelope.keyframe_id, index)
        if d.det_id is None
        else d.det_id
        for index, d in enumerate(envelope.detections)
    ]
    if len(set(ids)) == len(ids):
        return tuple(ids)
    seen: set[DetId] = set()
    for index, det_id in enumerate(ids):
        if det_id in seen:
            raise _RefusalError(
                f"detections.{index}.det_id: {det_id!r} stands twice in one envelope"
            )
        seen.add(det_id)
    return tuple(ids)


def _vectors(envelope: Envelope) -> tuple[Vector | None, ...]:
    detections = envelope.detections
    rows = _rows_of_one_kind(detections)
    if rows is not None:
        return tuple(rows)
    return tuple(
        None if d.embedding is None else _vector(index, d) for index, d in enumerate(detections)
    )


def _rows_of_one_kind(detections: Sequence[Detection]) -> Vector | None:
    """All vectors, shape (len(detections), dim), if there is nothing odd about them, as a rule;
    None to look closer."""
    try:
        raws = [pybase64.b64decode(d.embedding, None, True) for d in detections]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return None
    dims = {d.embedding_dim for d in detections}
    sizes = {*map(len, raws)}
    if None in dims or len(dims) != 1 or sizes != {4 * dim for dim in dims if dim}:
        return None
    rows = np.frombuffer(b"".join(raws), _FLOAT32).reshape(len(raws), -1)
    # A squared norm that is 0, infinite or NaN says that a component may be.
    for norm2 in np.einsum("ij,ij->i", rows, rows).tolist():
        if not 0.0 < norm2 < math.inf:
            return None
    return rows


def _vector(index: int, detection: Detection) -> Vector:
    place = f"detections.{index}.embedding"
    raw = _base64(place, detection.embedding or "")
    dim = detection.embedding_dim
    if dim is None:
        raise _RefusalError(f"detections.{index}.embedding_dim: required beside an embedding")
    if len(raw) != 4 * dim:
        raise _RefusalError(
            f"{place}: {len(raw)} bytes do not match embedding_dim {dim}, which takes {4 * dim}"
        )
    vector = np.frombuffer(raw, dtype="<f4")
    largest = float(np.abs(vector).max())
    if not np.isfinite(largest):
        raise _RefusalError(f"{place}: holds NaN or infinity")
    if largest == 0.0:
        raise _RefusalError(f"{place}: is the zero vector, which has no direction")
    return vector


def _base64(place: str, text: str) -> bytes:
    try:
        return pybase64.b64decode(text, None, True)
    except ValueError:
        raise _RefusalError(f"{place}: not base64: {_base64_fault(text)}") from None


def _base64_fault(text: str) -> str:
    """What is wrong with it, in the words of the standard library, which not every version of it
    says of too much padding; so it is never the judge."""
    try:
        binascii.a2b_base64(text, strict_mode=True)
    except ValueError as error:
        return str(error)
    return "Excess padding"
