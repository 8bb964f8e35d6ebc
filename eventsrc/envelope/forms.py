"""Read the two forms that robots publish: our envelope, and the bare list of a detector.

The channel of an event says which form its payload has, as the version of its envelopes:

    1   the bare list of a detector without envelopes: ``[{"class_name": "cup",
        "confidence": 0.87, "bbox": [120.0, 80.0, 250.0, 310.0]}, …]``. It has no run, time
        or pose, so the event around it supplies them: the run is ``unnamed:<key>``, the keyframe id
        is the event's offset, the time is the event's stamp, and there is no pose. So it becomes
        observations without a place. ``class_name`` becomes ``class``.
    5   the envelope of `eventsrc.envelope.model`.

Versions 2 to 4 were never released; their events are refused, and an import of their log takes them
for envelopes of today.
"""

import json
from collections.abc import Sequence
from typing import Any, Final, Protocol

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
)
from .model import ENVELOPE_VERSION, MAX_DETECTIONS, contains_non_finite

BARE_LIST_VERSION: Final = 1
_BARE_FIELDS: Final = (
    *("class", "confidence", "bbox", "det_id"),
    *("embedding", "embedding_dim", "embedding_model"),
)
"""The fields of a detection in a bare list; others are ignored."""


class VersionedEvent(Protocol):
    """The fields of an event that its form depends on. `eventsrc.log.Event` has them."""

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
    """Validate an event of either form as an envelope."""
    if event.version == ENVELOPE_VERSION:
        return ingest(event.payload, max_bytes=max_bytes)
    if event.version == BARE_LIST_VERSION:
        return _read_bare_list(event, max_bytes)
    if BARE_LIST_VERSION < event.version < ENVELOPE_VERSION:
        return Rejected(
            f"envelope version {event.version} was never released; import the log into a new one, "
            f"which reads it as version {ENVELOPE_VERSION}"
        )
    return Rejected(f"envelope version {event.version} is unknown here; upgrade mapfold")


def read_envelopes(
    events: Sequence[VersionedEvent], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Accepted | Rejected]:
    """`read_envelope` each event; faster than one by one if all are envelopes."""
    if any(event.version != ENVELOPE_VERSION for event in events):
        return [read_envelope(event, max_bytes=max_bytes) for event in events]
    return ingest_all([event.payload for event in events], max_bytes=max_bytes)


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


def _read_bare_list(event: VersionedEvent, max_bytes: int) -> Accepted | Rejected:
    rejected = check_cost(event.payload, max_bytes)
    if rejected is not None:
        return rejected
    try:
        document = json.loads(event.payload)
        payload = json.dumps(_as_envelope(document, event)).encode()
    except (ValueError, RecursionError) as error:
        return Rejected(f"not an envelope of version {event.version}: {error}")
    read = ingest(payload, max_bytes=2 * max_bytes)
    if isinstance(read, Rejected) and "run_id" in document[0] and "detections" in document[0]:
        return Rejected("a list of envelopes; each must be a message, or a line, of its own")
    return read


def _as_envelope(document: Any, event: VersionedEvent) -> dict[str, Any]:
    if contains_non_finite(document):  # also in fields that are ignored
        raise ValueError("holds NaN or infinity")
    if not isinstance(document, list) or not all(isinstance(d, dict) for d in document):
        raise ValueError("not a list of detections")
    if len(document) > MAX_DETECTIONS:
        raise ValueError(f"{len(document)} detections, more than {MAX_DETECTIONS}")
    return {
        "run_id": f"unnamed:{event.key}",
        "keyframe_id": event.offset,
        "timestamp": event.stamp_ns / 1e9,
        "detections": [_as_detection(detection) for detection in document],
    }


def _as_detection(detection: dict[str, Any]) -> dict[str, Any]:
    """The known fields of a detection, with ``class_name`` renamed to ``class``."""
    known: dict[str, Any] = {name: detection[name] for name in _BARE_FIELDS if name in detection}
    if "class" not in detection and "class_name" in detection:
        known["class"] = detection["class_name"]
    return known
