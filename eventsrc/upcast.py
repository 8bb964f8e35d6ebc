"""Reading yesterday's logs: old forms of the envelope climb a ladder to today's.

A log keeps payloads as they came, so what a form means must outlive the robots that sent it. Each
channel of a log says the version of its envelopes; `read_envelope` takes an event up from its
version, one step at a time, and through the same door as new ones.

    1   the bare list of a detector, before there was an envelope: ``[{"class_name": "cup",
        "confidence": 0.87, "bbox": [120.0, 80.0, 250.0, 310.0]}, …]``. It does not say who saw it,
        when and where; the event around it says what can be said: the run is ``unnamed:<key>``,
        the keyframe id is the event's offset, the time is the event's stamp, and there is no pose.
        So it becomes observations without a place. ``class_name`` became ``class``.
    2   the envelope of DESIGN section 3.

To change the envelope: raise ENVELOPE_VERSION, write the step from the version before, and add a
log of that version to the tests. Never change a step that has been released.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple, Protocol

from .envelope import (
    ENVELOPE_VERSION,
    MAX_DETECTIONS,
    Detection,
    Envelope,
    Offset,
    holds_not_finite,
)
from .ingest import (
    DEFAULT_MAX_PAYLOAD_BYTES,
    Accepted,
    Rejected,
    check_all,
    excess,
    ingest,
    ingest_all,
)

BARE_LIST_VERSION = 1
_DETECTION_FIELDS = tuple(field.alias or name for name, field in Detection.model_fields.items())


class Recorded(Protocol):
    """What a step may know of the event around a payload; `eventsrc.log.Event` is one."""

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


Step = Callable[[Any, Recorded], Any]
"""From the JSON value of one version to that of the next. Raises ValueError for what is none."""


class Arrival(NamedTuple):
    """A payload that is about to be recorded, as far as a step may know it."""

    offset: Offset
    key: str
    stamp_ns: int
    payload: bytes
    version: int


def read_envelope(
    event: Recorded, *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> Accepted | Rejected:
    """The envelope of an event of any version."""
    if event.version == ENVELOPE_VERSION:
        return ingest(event.payload, max_bytes=max_bytes)
    if event.version not in LADDER:
        return Rejected(f"envelope version {event.version} is unknown here; upgrade mapfold")
    refused = excess(event.payload, max_bytes)
    if refused is not None:
        return refused
    try:
        document = _finite(json.loads(event.payload))
        for version in range(event.version, ENVELOPE_VERSION):
            document = LADDER[version](document, event)
        payload = json.dumps(document).encode()
    except (ValueError, RecursionError) as error:
        return Rejected(f"not an envelope of version {event.version}: {error}")
    return ingest(payload, max_bytes=2 * max_bytes)


def read_envelopes(
    events: Sequence[Recorded], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Accepted | Rejected]:
    """`read_envelope` of each; quicker together if all are of today's version."""
    if any(event.version != ENVELOPE_VERSION for event in events):
        return [read_envelope(event, max_bytes=max_bytes) for event in events]
    return ingest_all([event.payload for event in events], max_bytes=max_bytes)


def check_envelopes(
    events: Sequence[Recorded], *, max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES
) -> list[Envelope | Rejected]:
    """What `read_envelopes` says to each, without its vectors and ids."""
    if any(event.version != ENVELOPE_VERSION for event in events):
        read = [read_envelope(event, max_bytes=max_bytes) for event in events]
        return [said if isinstance(said, Rejected) else said.envelope for said in read]
    return check_all([event.payload for event in events], max_bytes=max_bytes)


def guess_version(payload: bytes) -> int:
    """The version of a payload that does not say: a list with an object in it is a bare list."""
    if payload.startswith(b"{"):
        return ENVELOPE_VERSION
    start = payload[:64].split()
    return BARE_LIST_VERSION if b"".join(start).startswith(b"[{") else ENVELOPE_VERSION


def _finite(document: Any) -> Any:
    """The same, where unknown fields that a step leaves out hold no NaN or infinity either."""
    if holds_not_finite(document):
        raise ValueError("holds NaN or infinity")
    return document


def _envelope_around_bare_list(document: Any, event: Recorded) -> dict[str, Any]:
    if not isinstance(document, list) or not all(isinstance(d, dict) for d in document):
        raise ValueError("not a list of detections")
    if len(document) > MAX_DETECTIONS:
        raise ValueError(f"{len(document)} detections, more than {MAX_DETECTIONS}")
    return {
        "run_id": f"unnamed:{event.key}",
        "keyframe_id": event.offset,
        "timestamp": event.stamp_ns / 1e9,
        "detections": [_class_for_class_name(detection) for detection in document],
    }


def _class_for_class_name(detection: dict[str, Any]) -> dict[str, Any]:
    """The fields that an envelope knows; the others stay in the log. ``class`` is the only one that
    was called otherwise."""
    known = {name: detection[name] for name in _DETECTION_FIELDS if name in detection}
    if "class" not in detection and "class_name" in detection:
        known["class"] = detection["class_name"]
    return known


LADDER: Mapping[int, Step] = MappingProxyType({1: _envelope_around_bare_list})
"""The step up from each older version."""
