"""Validate a payload from outside and append it to a log, or its rejection.

An accepted payload is appended verbatim under its own key, stamped with the robot's time; the
channel has its version if it is of an older form (`eventsrc.upcast`). A refused one is appended
under ``mapfold/rejected``, with its key, its bytes and the reason, so nothing is dropped silently.
"""

from collections.abc import Sequence
from typing import TypeAlias

from eventsrc.transport.config import key_fault

from .envelope import ENVELOPE_VERSION, Envelope, Offset
from .ingest import DEFAULT_MAX_PAYLOAD_BYTES, Rejected, abbreviate
from .log import LogWriter, NewEvent
from .system_events import REJECTED_KEY, RejectedPayload
from .upcast import PendingEvent, check_envelopes, detect_version

PreparedEvent: TypeAlias = tuple[NewEvent, Envelope | Rejected]
"""The event to append for one payload, and the result of its validation."""


def append_payload(
    writer: LogWriter,
    key: str,
    payload: bytes,
    *,
    logged_ns: int | None = None,
    max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
) -> Envelope | Rejected:
    """Append ``payload``, which came under ``key``; returns the result of its validation.

    ``logged_ns`` is when it was received, now by default.
    """
    messages = [(key, payload)]
    ((event, result),) = prepare_events(writer, messages, logged_ns=logged_ns, max_bytes=max_bytes)
    writer.append_all([event])
    return result


def prepare_events(
    writer: LogWriter,
    messages: Sequence[tuple[str, bytes]],
    *,
    logged_ns: int | None = None,
    max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
) -> list[PreparedEvent]:
    """The events to append to ``writer`` next, one for each (key, payload), in this order.

    Faster together than one by one, with the same result. A dozen or two at a time is best, so that
    what is decoded of them fits the processor's cache.
    """
    logged = writer.now_ns() if logged_ns is None else logged_ns
    pending = [
        PendingEvent(Offset(offset), key, logged, payload, detect_version(payload))
        for offset, (key, payload) in enumerate(messages, writer.next_offset)
    ]
    results = _validate(pending, max_bytes)
    return list(zip(map(_event, pending, results), results, strict=True))


def _event(event: PendingEvent, result: Envelope | Rejected) -> NewEvent:
    _, key, logged, payload, version = event
    if isinstance(result, Rejected):
        return _rejected_event(key, payload, result.reason, logged)
    stamp = result.stamp_ns if version == ENVELOPE_VERSION else logged
    return NewEvent(key, payload, logged, stamp, version)


def _rejected_event(key: str, payload: bytes, reason: str, logged_ns: int) -> NewEvent:
    escaped = key.encode(errors="backslashreplace").decode()  # a lone surrogate is not UTF-8
    record = RejectedPayload.encode(escaped, reason, payload)
    return NewEvent(REJECTED_KEY, record, logged_ns, logged_ns)


def _validate(pending: Sequence[PendingEvent], max_bytes: int) -> list[Envelope | Rejected]:
    """Validate each payload, and the key that it came under."""
    results = check_envelopes(pending, max_bytes=max_bytes)
    keys = {event.key for event in pending}  # usually one
    faults = {key: fault for key in keys if (fault := key_fault(key)) is not None}
    for index, event in enumerate(pending if faults else ()):
        if event.key in faults:
            results[index] = Rejected(f"key {abbreviate(event.key)} {faults[event.key]}")
    return results
