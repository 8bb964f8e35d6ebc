"""The one way a payload from outside gets into a log: through the door, or into the reject bin.

An accepted payload is appended as it came, under its own key, stamped with the robot's time. A
refused one is appended too, under ``mapfold/rejected``, with its key, its bytes and the reason:
nothing is dropped in silence.
"""

from eventsrc.ingest import DEFAULT_MAX_PAYLOAD_BYTES, Accepted, Rejected, ingest
from eventsrc.log import LogWriter
from eventsrc.system_events import REJECTED_KEY, RejectedPayload, is_system_key


def append_payload(
    writer: LogWriter,
    key: str,
    payload: bytes,
    *,
    logged_ns: int | None = None,
    max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
) -> Accepted | Rejected:
    """Append ``payload``, which came under ``key``; what the door said.

    ``logged_ns`` is when it was received, if that was earlier and elsewhere; otherwise now.
    """
    outcome = _judge(key, payload, max_bytes)
    if isinstance(outcome, Accepted):
        writer.append(key, payload, stamp_ns=outcome.envelope.stamp_ns, logged_ns=logged_ns)
    else:
        reject_payload(writer, key, payload, outcome.reason, logged_ns=logged_ns)
    return outcome


def reject_payload(
    writer: LogWriter, key: str, payload: bytes, reason: str, *, logged_ns: int | None = None
) -> int:
    """Keep refused bytes and the reason; the offset they got."""
    record = RejectedPayload.of(key, reason, payload)
    return writer.append(REJECTED_KEY, record.model_dump_json().encode(), logged_ns=logged_ns)


def _judge(key: str, payload: bytes, max_bytes: int) -> Accepted | Rejected:
    if is_system_key(key):
        return Rejected(f"key {key!r} is reserved for mapfold's own events")
    return ingest(payload, max_bytes=max_bytes)
