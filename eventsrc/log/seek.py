"""Find a point in a log from text: how many events come before it.

    17                      the first 17 events, offsets 0 to 16
    end                     all events
    2026-03-24T13:05:00Z    up to and including the last event stamped at or before this time
                            (UTC unless it says otherwise; a date alone is its midnight)
    robot-1:42              up to and including the first event with keyframe 42 of run robot-1

Times are the robots' (stamp_ns): a run of last week that is imported today has last week's times.
Stamps may run backwards between runs and when a clock is set; "the last event at or before"
includes every event of that time or earlier, wherever it is in the log.

mapfold's own events are stamped when they were written, verbatim messages by clocks of their own,
and the stamps of unreadable events are unknown. All of them count as stamped like the robots' event
before them, and at the start of the log as earlier than all. A range that ends at a time includes a
damaged stretch if it includes the event before it or any event after it. Reading the range then
raises LogDamaged. Only damage at the end of a log, with no readable event after it, is reported
here.
"""

import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

from pydantic import BaseModel, ValidationError

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, whole_number
from eventsrc.envelope.model import KeyframeId, Offset, RunId

from .event import Event
from .reader import LogReader, OnGap
from .segment import Unreadable

_KEYFRAME_OF_RUN = re.compile(r"(.+):(-?[0-9]+)", re.DOTALL)
_KEYFRAME = re.compile(rb'"keyframe_id"\s*:\s*(-?[0-9]{1,19})(?![0-9])')
_LIKE_A_TIME = re.compile(r"[\dT:.,+Z -]+")
_MAX_SHOWN = 200
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class _Identity(BaseModel):
    run_id: RunId
    keyframe_id: KeyframeId


Note = Callable[[str], None]
"""Receives one line of text for people."""


def resolve(
    reader: LogReader, text: str, *, on_gap: OnGap | None = None, note: Note | None = None
) -> Offset:
    """The number of events before the point ``text``; MisuseError if the log has no such point.

    ``note`` gets a line if events stamped later than a given time are included. Raises LogDamaged,
    or calls ``on_gap``, for damage before the keyframe that is looked for, and for damage at the
    end of the log if the range reaches it.
    """
    if text == "end":
        return _at_end(reader, on_gap)
    if text.isascii() and text.isdecimal():
        return _checked_offset(reader, text)
    time_ns = time_of(text)
    if time_ns is not None:
        included, later = _at_time(reader, time_ns, on_gap)
        if later and note is not None:
            note(
                f"{reader.path}: of the {counted(included, 'event')} up to {text}, {later:,} "
                f"{'is' if later == 1 else 'are'} stamped later: stamps run backwards in this log; "
                "an offset or RUN:KEYFRAME is exact"
            )
        return included
    keyframe = _KEYFRAME_OF_RUN.fullmatch(text)
    found = keyframe and _at_keyframe(
        reader, RunId(keyframe[1]), KeyframeId(whole_number(keyframe[2])), on_gap
    )
    if found:
        return found
    raise MisuseError(_no_point_message(reader, text, named=keyframe is not None))


def _no_point_message(reader: LogReader, text: str, *, named: bool) -> str:
    if not named:
        return (
            f"{_shown(text)!r} is no point in a log; give an offset, a time such as"
            " 2026-03-24T13:00:00Z, RUN:KEYFRAME or end"
        )
    no_time = (
        ", nor is this a time, which is written with its date, such as 2026-03-24T13:00:00Z"
        if _LIKE_A_TIME.fullmatch(text)
        else ""
    )
    return (
        f"{_shown(text)}: {reader.path} has no such keyframe{no_time}; "
        f"`{advised('log', 'cat', reader.path)}` lists what it has"
    )


def _shown(text: str) -> str:
    return text if len(text) <= _MAX_SHOWN else f"{text[: _MAX_SHOWN - 1]}…"


def resolve_start(reader: LogReader, text: str, *, on_gap: OnGap | None = None) -> Offset:
    """The offset of the first event from the point ``text`` on: for a keyframe its own event, for a
    time the robots' first event stamped then or later.

    Raises LogDamaged, or calls ``on_gap``, for damage before that event.
    """
    time_ns = time_of(text)
    if time_ns is not None:
        events = (e for e in reader.read(on_gap=on_gap) if e.is_envelope)
        later = (e.offset for e in events if e.stamp_ns >= time_ns)
        return next(later, reader.readable_end)
    count = resolve(reader, text, on_gap=on_gap)
    return count if text == "end" or text.isdecimal() else Offset(count - 1)


def _checked_offset(reader: LogReader, text: str) -> Offset:
    offset = Offset(whole_number(text))
    if offset > reader.end_for(offset):
        raise MisuseError(
            f"{_shown(text)} is beyond the end of {reader.path}, which holds "
            f"{counted(reader.next_offset, 'event')}; use end"
        )
    return offset


def time_of(text: str) -> int | None:
    """Int nanoseconds of an ISO 8601 time; None for other text, and for an offset
    (``20260324``)."""
    if text.isdecimal() or not re.match(r"\d{4}-?\d{2}-?\d{2}", text):
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - _EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _at_time(reader: LogReader, time_ns: int, on_gap: OnGap | None) -> tuple[Offset, int]:
    """How many events are included, and how many of them are robots' events of a later time."""
    included: int = 0
    later = later_included = 0
    in_time = True

    def include(gap: Unreadable) -> None:
        nonlocal included
        if in_time:
            included = gap.last + 1

    for event in reader.read(on_gap=include):
        if event.is_envelope:
            in_time = event.stamp_ns <= time_ns
            later += not in_time
        if in_time:
            included, later_included = event.offset + 1, later
    if included > reader.readable_end:
        return _at_end(reader, on_gap), later_included
    return Offset(included), later_included


def _at_end(reader: LogReader, on_gap: OnGap | None) -> Offset:
    """The end of the log; reading from there reports events that its last segment has lost."""
    list(reader.read(reader.readable_end, on_gap=on_gap))
    return reader.readable_end


def _at_keyframe(
    reader: LogReader, run_id: RunId, keyframe_id: KeyframeId, on_gap: OnGap | None
) -> Offset | None:
    for event in _events_mentioning(reader, keyframe_id, on_gap):
        try:
            identity = _Identity.model_validate_json(event.payload)
        except ValidationError:
            continue
        if (identity.run_id, identity.keyframe_id) == (run_id, keyframe_id):
            return Offset(event.offset + 1)
    return None


def _events_mentioning(
    reader: LogReader, keyframe_id: KeyframeId, on_gap: OnGap | None
) -> Iterator[Event]:
    """Events whose text contains that keyframe id. Parsing all events takes 20 times as long."""
    for event in reader.read(on_gap=on_gap):
        if event.is_envelope and any(
            int(m[1]) == keyframe_id for m in _KEYFRAME.finditer(event.payload)
        ):
            yield event
