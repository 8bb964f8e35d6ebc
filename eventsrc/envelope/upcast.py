"""Upcast older versions of the envelope to the current one, step by step, when they are read.

A log keeps payloads as they came, so it must stay readable when the envelope changes. Each channel
of a log has the version of its envelopes; `read_envelope` converts an event from its version to the
current one and validates it like a new one.

    1   the bare list of a detector, before there was an envelope: ``[{"class_name": "cup",
        "confidence": 0.87, "bbox": [120.0, 80.0, 250.0, 310.0]}, …]``. It has no run, time
        or pose, so the event around it supplies them: the run is ``unnamed:<key>``, the keyframe id
        is the event's offset, the time is the event's stamp, and there is no pose. So it becomes
        observations without a place. ``class_name`` became ``class``.
    2   the envelope before it had a camera, and detections a depth or a position. It may have had
        unknown fields of these names, with any content: they are dropped.
    3   the envelope before it had a floor or a height; unknown fields of these names are dropped.
    4   the envelope before it had the covariance of its pose; an unknown field of that name is
        dropped.
    5   the envelope of `eventsrc.envelope.model`.

To change the envelope: raise ENVELOPE_VERSION, add the upcaster from the version before to
``UPCASTERS``, and a log of that version to the tests. Never change a released upcaster.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Protocol

import msgspec

from .ingest import (
    DEFAULT_MAX_PAYLOAD_BYTES,
    Accepted,
    CheckedEnvelope,
    Rejected,
    check_all,
    check_cost,
    ingest,
    ingest_all,
    ingest_plain,
)
from .model import (
    ENVELOPE_VERSION,
    MAX_DETECTIONS,
    Detection,
    contains_non_finite,
    has_evidence,
    has_floor,
)

BARE_LIST_VERSION = 1
_DETECTION_FIELDS = tuple(field.alias or name for name, field in Detection.model_fields.items())


class VersionedEvent(Protocol):
    """The fields of an event that upcasters may use. `eventsrc.log.Event` has them."""

    @property
    def offset(self) -> int: ...
    @property
    def key(self) -> str: ...
    @property
    def stamp_ns(self) -> int: ...
    @property
    def payload(self) -> bytes: ...
    @property
    def version(self) -> int: ...


Upcaster = Callable[[Any, VersionedEvent], Any]
"""Converts the JSON value of one version to the next. Raises ValueError if it is invalid."""


class PendingEvent(msgspec.Struct, frozen=True, gc=False):
    """A payload that is about to be appended, as a `VersionedEvent`."""

    offset: int
    key: str
    stamp_ns: int
    payload: bytes
    version: int


def read_envelope(
    event: VersionedEvent, *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> Accepted | Rejected:
    """Validate an event of any version as an envelope of the current one."""
    if event.version in _SAME_BUT_FOR_NEW_FIELDS:
        read = ingest(event.payload, max_bytes=max_bytes)
        return _converted(event, max_bytes) if _must_convert(event, read) else read
    if event.version not in UPCASTERS:
        return Rejected(f"envelope version {event.version} is unknown here; upgrade mapfold")
    return _converted(event, max_bytes)


def _converted(event: VersionedEvent, max_bytes: int) -> Accepted | Rejected:
    rejected = check_cost(event.payload, max_bytes)
    if rejected is not None:
        return rejected
    try:
        document = _require_finite(json.loads(event.payload))
        for version in range(event.version, ENVELOPE_VERSION):
            document = UPCASTERS[version](document, event)
        payload = json.dumps(document).encode()
    except (ValueError, RecursionError) as error:
        return Rejected(f"not an envelope of version {event.version}: {error}")
    read = ingest(payload, max_bytes=2 * max_bytes)
    if isinstance(read, Rejected) and _lists_envelopes(event):
        return Rejected("a list of envelopes; each must be a message, or a line, of its own")
    return read


def _lists_envelopes(event: VersionedEvent) -> bool:
    """Whether a payload taken for a bare list is one of envelopes."""
    if event.version != BARE_LIST_VERSION:
        return False
    first = json.loads(event.payload)[0]
    return "run_id" in first and "detections" in first


def read_envelopes(
    events: Sequence[VersionedEvent], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Accepted | Rejected]:
    """`read_envelope` each event; faster than one by one unless one has version 1."""
    if any(event.version not in _SAME_BUT_FOR_NEW_FIELDS for event in events):
        return [read_envelope(event, max_bytes=max_bytes) for event in events]
    read = ingest_all([event.payload for event in events], max_bytes=max_bytes)
    for index, event in enumerate(events):
        if _must_convert(event, read[index]):
            read[index] = _converted(event, max_bytes)
    return read


def read_fields(
    events: Sequence[VersionedEvent], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> Sequence[Accepted | Rejected]:
    """Like `read_envelopes`, faster, for callers that only read fields: see `ingest_plain`."""
    if all(event.version == ENVELOPE_VERSION for event in events):
        plain = ingest_plain([event.payload for event in events], max_bytes=max_bytes)
        if plain is not None:
            return plain
    return read_envelopes(events, max_bytes=max_bytes)


def check_envelopes(
    events: Sequence[VersionedEvent], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[CheckedEnvelope | Rejected]:
    """Like `read_envelopes`, but without vectors; faster, for callers that only keep the bytes."""
    if any(event.version != ENVELOPE_VERSION for event in events):
        read = read_envelopes(events, max_bytes=max_bytes)
        return [r if isinstance(r, Rejected) else CheckedEnvelope.of(r.envelope) for r in read]
    return check_all([event.payload for event in events], max_bytes=max_bytes)


def detect_version(payload: bytes) -> int:
    """The version of a payload, by its first bytes: 1 for a list of objects, else the current."""
    if payload.startswith(b"{"):
        return ENVELOPE_VERSION
    start = payload[:64].split()
    return BARE_LIST_VERSION if b"".join(start).startswith(b"[{") else ENVELOPE_VERSION


def _require_finite(document: Any) -> Any:
    """``document``; ValueError for NaN or infinity anywhere, also in fields an upcaster drops."""
    if contains_non_finite(document):
        raise ValueError("holds NaN or infinity")
    return document


def _upcast_bare_list(document: Any, event: VersionedEvent) -> dict[str, Any]:
    if not isinstance(document, list) or not all(isinstance(d, dict) for d in document):
        raise ValueError("not a list of detections")
    if len(document) > MAX_DETECTIONS:
        raise ValueError(f"{len(document)} detections, more than {MAX_DETECTIONS}")
    return {
        "run_id": f"unnamed:{event.key}",
        "keyframe_id": event.offset,
        "timestamp": event.stamp_ns / 1e9,
        "detections": [_upcast_detection(detection) for detection in document],
    }


def _upcast_detection(detection: dict[str, Any]) -> dict[str, Any]:
    """The known fields of a detection, with ``class_name`` renamed to ``class``."""
    known = {name: detection[name] for name in _DETECTION_FIELDS if name in detection}
    if "class" not in detection and "class_name" in detection:
        known["class"] = detection["class_name"]
    return known


_NEW_IN_ENVELOPE: Mapping[int, frozenset[str]] = MappingProxyType(
    {
        2: frozenset({"camera"}),
        3: frozenset({"floor", "map_z"}),
        4: frozenset({"pose_covariance"}),
    }
)
"""By version, the envelope fields that the next version added."""
_NEW_IN_DETECTION = frozenset({"depth_m", "depth_sigma_m", "position", "position_sigma_m"})
"""Fields of a detection that version 2 did not have."""
_SAME_BUT_FOR_NEW_FIELDS = (2, 3, 4, 5)


def _must_convert(event: VersionedEvent, read: Accepted | Rejected) -> bool:
    """Whether an older envelope, which was read as a current one, must be converted and read again:
    it has fields that its version did not define. This is rare, so reading first is faster than
    converting each."""
    if event.version == ENVELOPE_VERSION:
        return False
    if isinstance(read, Rejected):
        return _has_new_fields(event)
    envelope = read.envelope
    return (
        envelope.pose_covariance is not None
        or (event.version < 4 and has_floor(envelope))
        or (event.version == 2 and has_evidence(envelope))
    )


def _has_new_fields(event: VersionedEvent) -> bool:
    try:
        document = converted = json.loads(event.payload)
        for version in range(event.version, ENVELOPE_VERSION):
            converted = UPCASTERS[version](converted, event)
        return bool(converted != document)
    except (ValueError, RecursionError):
        return False


def _drop_camera(document: Any, _event: VersionedEvent) -> Any:
    older = _without(document, _NEW_IN_ENVELOPE[2])
    if isinstance(older, dict) and isinstance(older.get("detections"), list):
        older["detections"] = [_without(each, _NEW_IN_DETECTION) for each in older["detections"]]
    return older


def _drop_floor(document: Any, _event: VersionedEvent) -> Any:
    return _without(document, _NEW_IN_ENVELOPE[3])


def _drop_pose_covariance(document: Any, _event: VersionedEvent) -> Any:
    return _without(document, _NEW_IN_ENVELOPE[4])


def _without(document: Any, names: frozenset[str]) -> Any:
    if not isinstance(document, dict):
        return document
    return {name: value for name, value in document.items() if name not in names}


UPCASTERS: Mapping[int, Upcaster] = MappingProxyType(
    {1: _upcast_bare_list, 2: _drop_camera, 3: _drop_floor, 4: _drop_pose_covariance}
)
"""From each older version to the next."""
