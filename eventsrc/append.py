"""The one way a payload from outside gets into a log: through the door, or into the reject bin.

An accepted payload is appended as it came, under its own key, stamped with the robot's time; one
of an older form keeps its form and its channel says which (see `eventsrc.upcast`). A refused one is
appended too, under ``mapfold/rejected``, with its key, its bytes and the reason: nothing is dropped
in silence.
"""

from eventsrc.envelope import ENVELOPE_VERSION
from eventsrc.ingest import DEFAULT_MAX_PAYLOAD_BYTES, Accepted, Rejected
from eventsrc.log import LogWriter
from eventsrc.system_events import REJECTED_KEY, RejectedPayload, is_system_key
from eventsrc.upcast import Arrival, guess_version, read_envelope


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
    logged = writer.now_ns() if logged_ns is None else logged_ns
    arrival = Arrival(writer.next_offset, key, logged, payload, guess_version(payload))
    outcome = _judge(arrival, max_bytes)
    if isinstance(outcome, Rejected):
        reject_payload(writer, key, payload, outcome.reason, logged_ns=logged)
    else:
        stamp_ns = outcome.envelope.stamp_ns if arrival.version == ENVELOPE_VERSION else logged
        writer.append(key, payload, stamp_ns=stamp_ns, logged_ns=logged, version=arrival.version)
    return outcome


def reject_payload(
    writer: LogWriter, key: str, payload: bytes, reason: str, *, logged_ns: int | None = None
) -> int:
    """Keep refused bytes and the reason; the offset they got."""
    record = RejectedPayload.of(key, reason, payload)
    return writer.append(REJECTED_KEY, record.model_dump_json().encode(), logged_ns=logged_ns)


def _judge(arrival: Arrival, max_bytes: int) -> Accepted | Rejected:
    if is_system_key(arrival.key):
        return Rejected(f"key {arrival.key!r} is reserved for mapfold's own events")
    return read_envelope(arrival, max_bytes=max_bytes)
