"""The one way a payload from outside gets into a log: through the door, or into the reject bin.

An accepted payload is appended as it came, under its own key, stamped with the robot's time; one
of an older form keeps its form and its channel says which (see `eventsrc.upcast`). A refused one is
appended too, under ``mapfold/rejected``, with its key, its bytes and the reason: nothing is dropped
in silence.
"""

from collections.abc import Sequence
from typing import TypeAlias

from eventsrc.transport.config import key_fault

from .envelope import ENVELOPE_VERSION, Envelope, Offset
from .ingest import DEFAULT_MAX_PAYLOAD_BYTES, Rejected, quoted
from .log import LogWriter, NewEvent
from .system_events import REJECTED_KEY, RejectedPayload
from .upcast import Arrival, check_envelopes, guess_version

Judged: TypeAlias = tuple[NewEvent, Envelope | Rejected]
"""What gets into the log for one payload, and what the door said to it."""


def append_payload(
    writer: LogWriter,
    key: str,
    payload: bytes,
    *,
    logged_ns: int | None = None,
    max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
) -> Envelope | Rejected:
    """Append ``payload``, which came under ``key``; what the door said.

    ``logged_ns`` is when it was received, if that was earlier and elsewhere; otherwise now.
    """
    messages = [(key, payload)]
    ((event, verdict),) = judge_payloads(writer, messages, logged_ns=logged_ns, max_bytes=max_bytes)
    writer.append_all([event])
    return verdict


def judge_payloads(
    writer: LogWriter,
    messages: Sequence[tuple[str, bytes]],
    *,
    logged_ns: int | None = None,
    max_bytes: int = DEFAULT_MAX_PAYLOAD_BYTES,
) -> list[Judged]:
    """What to append to ``writer`` for each (key, payload): as its next events, in this order.

    Quicker together than one by one, and no different. A dozen or two at a time is best: what is
    decoded of them should fit the processor's cache.
    """
    logged = writer.now_ns() if logged_ns is None else logged_ns
    arrivals = [
        Arrival(Offset(offset), key, logged, payload, guess_version(payload))
        for offset, (key, payload) in enumerate(messages, writer.next_offset)
    ]
    verdicts = _judge(arrivals, max_bytes)
    return list(zip(map(_event, arrivals, verdicts), verdicts, strict=True))


def _event(arrival: Arrival, verdict: Envelope | Rejected) -> NewEvent:
    _, key, logged, payload, version = arrival
    if isinstance(verdict, Rejected):
        return _rejected(key, payload, verdict.reason, logged)
    stamp = verdict.stamp_ns if version == ENVELOPE_VERSION else logged
    return NewEvent(key, payload, logged, stamp, version)


def _rejected(key: str, payload: bytes, reason: str, logged_ns: int) -> NewEvent:
    named = key.encode(errors="backslashreplace").decode()  # half a surrogate pair is no UTF-8
    record = RejectedPayload.encode(named, reason, payload)
    return NewEvent(REJECTED_KEY, record, logged_ns, logged_ns)


def _judge(arrivals: Sequence[Arrival], max_bytes: int) -> list[Envelope | Rejected]:
    """What the door says, but for keys that a log does not keep envelopes under."""
    verdicts = check_envelopes(arrivals, max_bytes=max_bytes)
    keys = {arrival.key for arrival in arrivals}  # one, as a rule
    faults = {key: fault for key in keys if (fault := key_fault(key)) is not None}
    for index, arrival in enumerate(arrivals if faults else ()):
        if arrival.key in faults:
            verdicts[index] = Rejected(f"key {quoted(arrival.key)} {faults[arrival.key]}")
    return verdicts
