"""Append the envelopes that a killed recorder of ROS messages did not write.

A killed recorder may have written a message and not yet what it completes; and detections that
waited for a pose were not made into an envelope at all. Both follow from the messages in the log
(`eventsrc.ros.derivation`), so the next recorder appends them before it records. It must read
the last recording's messages once; after a regular end there is nothing to do. A recording that has
lost events to damage is left as it is.
"""

from collections import deque
from collections.abc import Iterator

from pydantic import ValidationError

from eventsrc.envelope.model import Offset
from eventsrc.envelope.system_events import LOSS_KEY, MAP_KEY, ROS_KEY, Loss
from eventsrc.log import Event, LogReader, LogWriter, VerbatimEvent
from eventsrc.record.append import append_payload, map_event
from eventsrc.ros.derivation import CDR, Derived, RosRecording, derive, identity_of, recording_of
from eventsrc.ros.library import MessageTypes


def append_missing(reader: LogReader, writer: LogWriter, types: MessageTypes) -> int:
    """Append the events that follow from the messages of the log's last recording of ROS and are
    not in it, and end that recording; returns how many. Raises LogDamaged."""
    last = None
    for event in reader.read(keys={ROS_KEY}):
        last = event
    if last is None:
        return 0
    recording = recording_of(last)
    if not recording.streams:
        return 0
    missing = _missing(reader, Offset(last.offset), types)
    for derived in missing:
        if derived.key == MAP_KEY:
            writer.append_all([map_event(derived.payload, writer.now_ns())])
        else:
            append_payload(writer, derived.key, derived.payload)
    writer.append(ROS_KEY, RosRecording(key=recording.key).encode())
    writer.sync()
    return len(missing)


def message_of(event: Event) -> tuple[str, str] | None:
    """Type and definition of an event that is a message of ROS in CDR, with its schema."""
    if not isinstance(event, VerbatimEvent):
        return None
    form = event.format
    if form.encoding != CDR or not form.schema_text:
        return None
    return form.schema, form.schema_text.decode(errors="replace")


def _missing(reader: LogReader, start: Offset, types: MessageTypes) -> list[Derived]:
    made: dict[tuple[str, int] | None, Derived] = {}
    maps: deque[Derived] = deque()
    has_losses = False

    def watched() -> Iterator[Event]:
        """Yield the events, and remove those that the log has from ``made`` and ``maps``."""
        nonlocal has_losses
        for event in reader.read(start):
            has_losses = has_losses or _is_rot(event)
            if event.key == MAP_KEY and maps:
                maps.popleft()
            elif event.is_envelope:
                made.pop(identity_of(event.payload), None)
            yield event

    for _, derived in derive(watched(), types, message_of):
        if derived.key == MAP_KEY:
            maps.append(derived)
        else:
            made[identity_of(derived.payload)] = derived
    return [] if has_losses else [*maps, *made.values()]


def _is_rot(event: Event) -> bool:
    """Whether an event replaces a lost one. If that was a message of ROS, the keyframes after it
    would get other numbers."""
    if event.key != LOSS_KEY:
        return False
    try:
        return Loss.model_validate_json(event.payload).cause == "rot"
    except ValidationError:
        return False
