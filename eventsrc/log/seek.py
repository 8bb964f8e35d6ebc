"""Points in a log, as a person writes them: how many events a map "at W" is made of.

    17                      the first 17 events, offsets 0 to 16
    end                     all of them
    2026-03-24T13:05:00Z    up to and including the last event stamped at or before this time
                            (UTC unless it says otherwise; a date alone is its midnight)
    robot-1:42              up to and including the first event with keyframe 42 of run robot-1

Times are the robot's (stamp_ns): a log imported today of a run of last week is asked in last
week's times. Stamps may run backwards between runs and when a clock is set; "the last event at or
before" includes every event of that time or earlier, wherever it stands.

mapfold's own events are stamped when we wrote them, so they do not say where a time is, and events
that cannot be read do not either. Both count as stamped like the robots' event before them, and at
the head of the log as earlier than all. So damage lies in a range that ends at a time if what is
before it does, or anything behind it; and who then reads that range meets the damage. Only at the
end of a growing segment there is nothing to read behind it, so it is met here.
"""

import re
from collections.abc import Callable, Iterator
from datetime import UTC, datetime

from pydantic import BaseModel, ValidationError

from eventsrc.envelope import KeyframeId, Offset, RunId
from eventsrc.errors import MisuseError
from eventsrc.system_events import is_system_key
from eventsrc.text import counted

from .event import Event
from .reader import LogReader, OnGap
from .segment import Unreadable

_KEYFRAME_OF_RUN = re.compile(r"(.+):(-?\d+)", re.DOTALL)
_KEYFRAME = re.compile(rb'"keyframe_id"\s*:\s*(-?\d+)')
_LIKE_A_TIME = re.compile(r"[\dT:.,+Z -]+")
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


class _Identity(BaseModel):
    run_id: RunId
    keyframe_id: KeyframeId


Note = Callable[[str], None]
"""Takes one line for people."""


def resolve(
    reader: LogReader, text: str, *, on_gap: OnGap | None = None, note: Note | None = None
) -> Offset:
    """The number of events that ``text`` means; MisuseError when the log has no such point.

    ``note`` is told when events stamped later than a time are in the range up to it.
    Damage on the way to a keyframe, and rot that a growing segment ends in where the range goes up
    to there, raise LogDamaged, or are told to ``on_gap``.
    """
    if text == "end":
        return _at_end(reader, on_gap)
    if text.isascii() and text.isdecimal():
        return _within(reader, Offset(int(text)))
    time_ns = time_of(text)
    if time_ns is not None:
        included, later = _at_time(reader, time_ns, on_gap)
        if later and note is not None:
            note(
                f"{reader.path}: of the {counted(included, 'event')} up to {text}, {later:,} "
                f"{'is' if later == 1 else 'are'} stamped later: stamps run backwards in this log; "
                "an offset or RUN:KEYFRAME says what you mean"
            )
        return included
    keyframe = _KEYFRAME_OF_RUN.fullmatch(text)
    found = keyframe and _at_keyframe(
        reader, RunId(keyframe[1]), KeyframeId(int(keyframe[2])), on_gap
    )
    if found:
        return found
    raise MisuseError(_no_point(reader, text, named=keyframe is not None))


def _no_point(reader: LogReader, text: str, *, named: bool) -> str:
    if not named:
        return (
            f"{text!r} is no point in a log; give an offset, a time such as 2026-03-24T13:00:00Z, "
            "RUN:KEYFRAME or end"
        )
    no_time = (
        ", nor is this a time, which is written with its date, such as 2026-03-24T13:00:00Z"
        if _LIKE_A_TIME.fullmatch(text)
        else ""
    )
    return (
        f"{text}: {reader.path} has no such keyframe{no_time}; "
        f"`mapfold log cat {reader.path}` lists what it has"
    )


def resolve_start(reader: LogReader, text: str, *, on_gap: OnGap | None = None) -> Offset:
    """The offset to start at so that what ``text`` names is included: an offset is itself, a
    keyframe its own event, a time the robots' first event stamped then or later.

    Damage on the way to a keyframe or a time raises LogDamaged, or is told to ``on_gap``.
    """
    time_ns = time_of(text)
    if time_ns is not None:
        events = (e for e in reader.read(on_gap=on_gap) if not is_system_key(e.key))
        later = (e.offset for e in events if e.stamp_ns >= time_ns)
        return next(later, reader.next_offset)
    count = resolve(reader, text, on_gap=on_gap)
    return count if text == "end" or text.isdecimal() else Offset(count - 1)


def _within(reader: LogReader, offset: Offset) -> Offset:
    if offset > reader.next_offset:
        raise MisuseError(
            f"{offset} is beyond the end of {reader.path}, which holds "
            f"{counted(reader.next_offset, 'event')}; use end"
        )
    return offset


def time_of(text: str) -> int | None:
    """Int nanoseconds of an ISO 8601 time; None when it is none, or an offset (``20260324``)."""
    if text.isdecimal() or not re.match(r"\d{4}-?\d{2}-?\d{2}", text):
        return None
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return None
    since = moment.replace(tzinfo=moment.tzinfo or UTC) - _EPOCH
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + since.microseconds * 1000


def _at_time(reader: LogReader, time_ns: int, on_gap: OnGap | None) -> tuple[Offset, int]:
    """How many events are included, and how many of them are the robots' of a later time."""
    included: int = 0
    later = later_included = 0
    in_time = True

    def take_in(gap: Unreadable) -> None:
        nonlocal included
        if in_time:
            included = gap.last + 1

    for event in reader.read(on_gap=take_in):
        if not is_system_key(event.key):
            in_time = event.stamp_ns <= time_ns
            later += not in_time
        if in_time:
            included, later_included = event.offset + 1, later
    if included > reader.next_offset:
        return _at_end(reader, on_gap), later_included
    return Offset(included), later_included


def _at_end(reader: LogReader, on_gap: OnGap | None) -> Offset:
    """Where there are no more events, unless more was recorded than the growing segment shows."""
    list(reader.read(reader.next_offset, on_gap=on_gap))
    return reader.next_offset


def _at_keyframe(
    reader: LogReader, run_id: RunId, keyframe_id: KeyframeId, on_gap: OnGap | None
) -> Offset | None:
    for event in _mentioning(reader, keyframe_id, on_gap):
        try:
            identity = _Identity.model_validate_json(event.payload)
        except ValidationError:
            continue
        if (identity.run_id, identity.keyframe_id) == (run_id, keyframe_id):
            return Offset(event.offset + 1)
    return None


def _mentioning(
    reader: LogReader, keyframe_id: KeyframeId, on_gap: OnGap | None
) -> Iterator[Event]:
    """Events whose text has that keyframe id somewhere: parsing all of them takes 20 times as
    long."""
    for event in reader.read(on_gap=on_gap):
        if not is_system_key(event.key) and any(
            int(m[1]) == keyframe_id for m in _KEYFRAME.finditer(event.payload)
        ):
            yield event
