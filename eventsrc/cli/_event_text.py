"""How `mapfold log cat` shows an event, to a program and to a person."""

import base64
import json
from datetime import UTC, datetime
from typing import Any

from eventsrc.log import Event
from eventsrc.terminal import visible

_SHORT = 100


def iso_time(time_ns: int) -> str:
    """UTC to the microsecond; the number itself beyond what a calendar holds."""
    try:
        moment = datetime.fromtimestamp(time_ns // 1_000_000_000, UTC)
    except (OverflowError, ValueError):
        return f"{time_ns} ns"
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{time_ns // 1000 % 1_000_000:06d}Z"


def event_document(event: Event) -> dict[str, Any]:
    """``{"offset", "logged_ns", "stamp_ns", "key", "payload"}``. The payload is its JSON value, or
    its text when it is no JSON; bytes that are no text come as ``payload_base64`` beside null."""
    document: dict[str, Any] = {
        "offset": event.offset,
        "logged_ns": event.logged_ns,
        "stamp_ns": event.stamp_ns,
        "key": event.key,
    }
    try:
        text = event.payload.decode()
    except UnicodeDecodeError:
        return {
            **document,
            "payload": None,
            "payload_base64": base64.b64encode(event.payload).decode(),
        }
    return {**document, "payload": _value(text)}


def _value(text: str) -> Any:
    try:
        return json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError):
        return text


def _refuse(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def event_line(event: Event) -> str:
    """Offset, time, key and the gist."""
    text = f"{event.offset:>8}  {iso_time(event.stamp_ns)}  {event.key}  {_gist(event)}"
    return visible(text)


def _gist(event: Event) -> str:
    value = _value(event.payload.decode(errors="replace"))
    if isinstance(value, dict) and isinstance(value.get("detections"), list):
        classes = [str(d.get("class", "?")) for d in value["detections"] if isinstance(d, dict)]
        seen = ", ".join(classes) or "nothing"
        return f"{value.get('run_id')}:{value.get('keyframe_id')} saw {seen}"
    text = event.payload.decode(errors="replace").replace("\n", " ")
    return text if len(text) <= _SHORT else text[: _SHORT - 1] + "…"
