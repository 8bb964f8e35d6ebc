"""Text and JSON of events, for `mapfold log cat`."""

import base64
import contextlib
import json
from datetime import UTC, datetime
from typing import Any

from pydantic import ValidationError

from eventsrc.base.text import counted, visible
from eventsrc.envelope.crops import CROP_SCHEMA, InvalidCrop, decode_crop
from eventsrc.envelope.model import ENVELOPE_VERSION
from eventsrc.envelope.occupancy_map import InvalidMap, OccupancyMapEvent, read_map_head
from eventsrc.envelope.system_events import (
    EMBEDDINGS_KEY,
    MAP_KEY,
    REJECTED_KEY,
    InvalidEmbeddings,
    RejectedPayload,
    decode_embeddings,
)
from eventsrc.log import Event, Finding, VerbatimEvent

_SUMMARY_CHARS = 100


def iso_time(time_ns: int) -> str:
    """UTC to the microsecond; the number itself outside the calendar's years 1 to 9999."""
    try:
        time = datetime.fromtimestamp(time_ns // 1_000_000_000, UTC)
    except (OverflowError, ValueError):
        return f"{time_ns} ns"
    return f"{time:%Y-%m-%dT%H:%M:%S}.{time_ns // 1000 % 1_000_000:06d}Z"


def event_document(event: Event) -> dict[str, Any]:
    """``{"offset", "logged_ns", "logged", "stamp_ns", "stamp", "key", "payload"}``; ``logged`` and
    ``stamp`` are ISO 8601. The payload is its JSON value, or its text when it is no JSON; bytes
    that are no text come as ``payload_base64`` beside null. So does a verbatim message, with its
    ``encoding`` and ``schema``. An envelope of an older form has its ``version``."""
    document: dict[str, Any] = {
        "offset": event.offset,
        "logged_ns": event.logged_ns,
        "logged": iso_time(event.logged_ns),
        "stamp_ns": event.stamp_ns,
        "stamp": iso_time(event.stamp_ns),
        "key": event.key,
    }
    if event.is_envelope and event.version != ENVELOPE_VERSION:
        document["version"] = event.version
    if isinstance(event, VerbatimEvent):
        document |= {"encoding": event.format.encoding, "schema": event.format.schema}
    else:
        with contextlib.suppress(UnicodeDecodeError):
            return {**document, "payload": _value(event.payload.decode())}
    encoded = base64.b64encode(event.payload).decode()
    return {**document, "payload": None, "payload_base64": encoded}


def _value(text: str) -> Any:
    try:
        return json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError):
        return text


def _reject_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def event_line(event: Event) -> str:
    """Offset, time, key and a summary of the payload."""
    text = f"{event.offset:>8}  {iso_time(event.stamp_ns)}  {event.key}  {_summary(event)}"
    return visible(text)


def _summary(event: Event) -> str:
    if isinstance(event, VerbatimEvent):
        form = event.format
        if form.schema == CROP_SCHEMA:
            with contextlib.suppress(InvalidCrop):  # another picture
                crop = decode_crop(event.payload)
                return f"crop of {crop.det_id}, {len(crop.jpeg):,} bytes"
        return f"{form.encoding} {form.schema}".rstrip() + f", {len(event.payload):,} bytes"
    if event.key == MAP_KEY:
        with contextlib.suppress(InvalidMap):  # `log verify` names it
            return _map_text(read_map_head(event.payload))
    if event.key == EMBEDDINGS_KEY:
        with contextlib.suppress(InvalidEmbeddings):  # `log verify` names it
            made = decode_embeddings(event.payload)
            count, dim = made.vectors.shape
            return f"{counted(count, 'vector')} of {made.space}, dimension {dim:,}"
    if event.key == REJECTED_KEY:
        with contextlib.suppress(ValidationError):  # made by another program
            refused = RejectedPayload.model_validate_json(event.payload)
            # The length of base64 says how many bytes it has, without decoding them.
            kept = len(refused.payload) // 4 * 3 - refused.payload[-2:].count("=")
            size = kept if refused.size is None else refused.size
            return f"{refused.key}, {size:,} bytes: {refused.reason}"
    value = _value(event.payload.decode(errors="replace"))
    if isinstance(value, dict) and isinstance(value.get("detections"), list):
        classes = [str(d.get("class", "?")) for d in value["detections"] if isinstance(d, dict)]
        seen = ", ".join(classes) or "nothing"
        return f"{value.get('run_id')}:{value.get('keyframe_id')} saw {seen}"
    text = event.payload.decode(errors="replace").replace("\n", " ")
    return text if len(text) <= _SUMMARY_CHARS else text[: _SUMMARY_CHARS - 1] + "…"


def _map_text(head: OccupancyMapEvent) -> str:
    name = "" if head.map_id is None else f" {head.map_id}"
    x, y, yaw = head.origin
    turned = f", turned by {yaw:g} rad" if yaw else ""
    floor = "" if head.floor is None else f", of floor {head.floor}"
    return (
        f"map{name} of {head.width:,} × {head.height:,} cells of {head.resolution:g} m from "
        f"({x:g}, {y:g}){turned}{floor}, from {head.source}"
    )


def finding_text(finding: Finding) -> str:
    """A finding in one line."""
    where = [finding.segment] if finding.segment else []
    if finding.first_offset is not None:
        first, last = finding.first_offset, finding.last_offset
        where.append(f"offset {first}" if first == last else f"offsets {first} to {last}")
    return visible(f"{finding.kind:<9} {': '.join([*where, finding.message])}")
