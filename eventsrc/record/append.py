"""Validate a payload from outside and append it to a log, or its rejection.

An accepted payload is appended verbatim under its own key, stamped with the robot's time; the
channel says if it is a bare list of detections (`eventsrc.envelope.forms`). A refused one is
appended under ``mapfold/rejected``, with its key, its bytes and the reason, so nothing is dropped
silently.

A payload that is no envelope but a nav_msgs/OccupancyGrid is appended as a ``mapfold/map`` event,
which has the same cells in a hundredth of the bytes.
"""

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import msgspec

from eventsrc.envelope import crops, grid_messages, ingest
from eventsrc.envelope.cdr import is_cdr
from eventsrc.envelope.dropped_classes import ClassDropper, DropClasses, Stripped
from eventsrc.envelope.forms import PendingEvent, check_envelopes, detect_version
from eventsrc.envelope.model import Offset, has_keyframe_id
from eventsrc.envelope.occupancy_map import InvalidMap
from eventsrc.envelope.system_events import (
    DROP_KEY,
    MAP_KEY,
    REJECTED_KEY,
    Excerpt,
    RejectedPayload,
)
from eventsrc.log import LogReader, LogWriter, MessageFormat, NewEvent

from .transport.config import key_fault

CROP_FORMAT: Final = MessageFormat(
    crops.CROP_ENCODING, crops.CROP_SCHEMA, crops.CROP_SCHEMA_ENCODING, crops.CROP_SCHEMA_TEXT
)
"""The format of crops of detections in a log."""


class NewMap(NamedTuple):
    """The JSON of a ``mapfold/map`` event, made of a nav_msgs/OccupancyGrid."""

    event: bytes


Result = ingest.CheckedEnvelope | NewMap | ingest.Rejected
NOTHING_DROPPED: Final = ClassDropper[Any]()


class Checked(msgspec.Struct, frozen=True, gc=False):
    """The version of a payload, and the result of its validation."""

    version: int
    result: Result

    @property
    def stamp_ns(self) -> int | None:
        """The robot's time; None if the payload is no envelope or its version has no time."""
        if not isinstance(self.result, ingest.CheckedEnvelope) or not has_keyframe_id(self.version):
            return None
        return self.result.stamp_ns


def append_payload(
    writer: LogWriter,
    key: str,
    payload: bytes,
    *,
    logged_ns: int | None = None,
    max_bytes: int = ingest.DEFAULT_MAX_PAYLOAD_BYTES,
    dropper: ClassDropper[Any] = NOTHING_DROPPED,
) -> Result:
    """Append ``payload``, received under ``key``, without what ``dropper`` leaves out, and return
    the result of its validation.

    ``logged_ns`` is the time of receipt, by default the current time.
    """
    logged = writer.now_ns() if logged_ns is None else logged_ns
    (checked,) = check_payloads(
        [(key, payload)],
        first=writer.next_offset,
        logged_ns=logged,
        max_bytes=max_bytes,
    )
    checked, stripped = without_dropped(payload, checked, dropper)
    writer.append_all([checked_event(key, stripped.payload, checked, logged, dropper)])
    return checked.result


def dropped_classes(reader: LogReader) -> frozenset[str]:
    """The classes that a log stores no detections of; what damage hides of them is passed over."""
    events = reader.read(keys={DROP_KEY}, on_gap=lambda _: None)
    found = (DropClasses.model_validate_json(event.payload).classes for event in events)
    return frozenset(name for classes in found for name in classes)


def without_dropped(
    payload: bytes, checked: Checked, dropper: ClassDropper[Any]
) -> tuple[Checked, Stripped]:
    """A checked payload without what ``dropper`` leaves out; a rejection if it is an envelope that
    cannot be read a second time."""
    if not (dropper and isinstance(checked.result, ingest.CheckedEnvelope)):
        return checked, Stripped(payload)
    try:
        return checked, dropper.strip(payload, checked.version)
    except ValueError as error:
        return Checked(checked.version, ingest.Rejected(str(error))), Stripped(payload)


def checked_event(
    key: str,
    payload: bytes,
    checked: Checked,
    logged_ns: int,
    dropper: ClassDropper[Any] = NOTHING_DROPPED,
) -> NewEvent:
    """The event to append for a payload received under ``key``, by the result of its check."""
    version, result = checked.version, checked.result
    if isinstance(result, ingest.Rejected):
        kept, reason = dropper.kept_of(payload), dropper.reason(result.reason)
        return rejected_event(key, kept, reason, logged_ns)
    if isinstance(result, NewMap):
        return map_event(result.event, logged_ns)
    stamp = checked.stamp_ns
    return NewEvent(key, payload, logged_ns, logged_ns if stamp is None else stamp, version)


def check_payloads(
    messages: Sequence[tuple[str, bytes]],
    *,
    first: Offset,
    logged_ns: int,
    max_bytes: int,
    version: int | None = None,
    are_grids: bool = False,
) -> list[Checked]:
    """Validate key and payload of each message (key, payload).

    Results are the same as one by one; together is faster. A dozen or two at a time is best: their
    decoded vectors then fit the processor's cache.

    ``first`` and ``logged_ns`` stand in for the keyframe id and the time of a bare list
    (`eventsrc.envelope.forms`), which has neither. For validation any offset and any time will do,
    so both may be earlier than those that the events get. ``version`` is the envelope version that
    another log has recorded them in; by default it is detected. With ``are_grids`` messages in
    CDR are occupancy grids whatever their keys.
    """
    pending = [
        PendingEvent(offset, key, logged_ns, payload, version or detect_version(payload))
        for offset, (key, payload) in enumerate(messages, first)
    ]
    results: list[ingest.CheckedEnvelope | NewMap | ingest.Rejected] = [
        *check_envelopes(pending, max_bytes=max_bytes)
    ]
    keys = {event.key for event in pending}  # usually one
    faults = {key: fault for key in keys if (fault := key_fault(key)) is not None}
    for index, event in enumerate(pending if faults else ()):
        if event.key in faults:
            results[index] = ingest.Rejected(
                f"key {ingest.abbreviate(event.key)} {faults[event.key]}"
            )
    for index, result in enumerate(results):
        if isinstance(result, ingest.Rejected) and pending[index].key not in faults:
            results[index] = _as_map(pending[index], max_bytes, are_grids) or result
    return [Checked(event.version, result) for event, result in zip(pending, results, strict=True)]


def _as_map(event: PendingEvent, max_bytes: int, is_grid: bool) -> NewMap | ingest.Rejected | None:
    """The occupancy map in a payload that is no envelope, or the reason why its grid is refused;
    None if the payload does not look like a grid."""
    if len(event.payload) > max_bytes or not grid_messages.is_grid_message(event.payload):
        return None
    if is_cdr(event.payload) and not is_grid and not grid_messages.names_grid(event.key):
        return ingest.Rejected(grid_messages.NO_GRID)
    try:
        return NewMap(grid_messages.read_grid_message(event.payload, event.key).encode())
    except InvalidMap as error:
        return ingest.Rejected(str(error))


def map_event(event: bytes, logged_ns: int) -> NewEvent:
    """The ``mapfold/map`` event of the JSON ``event``."""
    return NewEvent(MAP_KEY, event, logged_ns, logged_ns)


def rejected_event(key: str, payload: bytes | Excerpt, reason: str, logged_ns: int) -> NewEvent:
    """The ``mapfold/rejected`` event of a refused payload."""
    escaped = key.encode(errors="backslashreplace").decode()  # a lone surrogate is not UTF-8
    record = RejectedPayload.encode(escaped, reason, payload)
    return NewEvent(REJECTED_KEY, record, logged_ns, logged_ns)
