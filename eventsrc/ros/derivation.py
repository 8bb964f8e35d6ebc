"""Derive envelopes and maps from the ROS messages in a log: a pure function of its events.

An event on ``mapfold/ros`` begins a recording: it names the topics, their uses and the run of the
keyframes. Each verbatim message behind it is added to the `Derivation` with its log time, and
completes none, one or several envelopes. The next event on ``mapfold/ros`` ends the recording:
envelopes that still wait are then made without what they lack.

The recorder derives while it records, and appends each envelope right behind the message that
completed it. So readers of the log need no ROS types, and get the same numbers on every machine.
`derive` derives them again from a log: for the recorder that follows a killed one, and for tests.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from typing import Annotated, Any, Final, NamedTuple, Protocol

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.cdr_grids import GRID_SCHEMA
from eventsrc.envelope.grid_messages import read_grid_message
from eventsrc.envelope.model import RunId
from eventsrc.envelope.occupancy_map import InvalidMap
from eventsrc.envelope.system_events import MAP_KEY, ROS_KEY

from .assembler import Assembled, Assembler, RosMessage
from .library import MessageTypes, Undecodable
from .messages import BadMessage
from .stream import Counts, Stream

CDR: Final = "cdr"
ROS2MSG: Final = "ros2msg"
_MOST_TOPICS: Final = 1_000
_STREAMS: Final = TypeAdapter(tuple[Stream, ...])


class RosRecording(BaseModel):
    """The content of a ``mapfold/ros`` event: how envelopes are made of the messages behind it.

    ``key`` is that of the envelopes. ``streams`` are the topics of detections, each with its run
    and what goes with it; ``grids`` the topics of occupancy grids. Without any stream it ends the
    recording before it.
    """

    model_config = ConfigDict(frozen=True, extra="ignore")

    key: str
    streams: Annotated[tuple[Stream, ...], Field(max_length=_MOST_TOPICS)] = ()
    grids: Annotated[tuple[str, ...], Field(max_length=_MOST_TOPICS)] = ()

    def encode(self) -> bytes:
        """The event's JSON."""
        streams = _STREAMS.dump_python(self.streams, mode="json")
        document = {"key": self.key, "streams": streams, "grids": self.grids}
        return json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()


def read_recording(payload: bytes) -> RosRecording:
    """The content of a ``mapfold/ros`` event. Raises ValidationError."""
    return RosRecording.model_validate_json(payload)


class Derived(NamedTuple):
    """An event made of messages: the JSON of an envelope, or with ``key`` ``mapfold/map`` of a map.
    ``stamp_ns`` is the stamp of the detections; None for a map."""

    key: str
    stamp_ns: int | None
    payload: bytes


class Derivation:
    """Makes the envelopes and maps of one recording from its messages, in the order of the log."""

    def __init__(self, recording: RosRecording, types: MessageTypes) -> None:
        self._key = recording.key
        self._grids = frozenset(recording.grids)
        self._assembler: Assembler[Derived] = Assembler(recording.streams)
        self._types = types
        self._defined: dict[str, str] = {}
        self.refused: dict[str, int] = {}
        """Number of messages that cannot be read, by topic."""
        self.reasons: dict[str, str] = {}
        """The reason for the first of them, by topic."""

    @property
    def topics(self) -> frozenset[str]:
        """The topics whose messages are used."""
        return self._assembler.topics | self._grids

    @property
    def counts(self) -> dict[str, Counts]:
        """The counts of each stream, by topic of detections."""
        return self._assembler.counts

    def add(
        self, topic: str, type_name: str, definition: str, logged_ns: int, payload: bytes
    ) -> list[Derived]:
        """Add a message; return the envelopes and maps that it completes. One that cannot be read
        is counted. ``definition`` is the text that defines its type, empty if unknown."""
        try:
            if topic in self._grids:
                return self._finished(self._map(topic, type_name, logged_ns, payload))
            if topic not in self._assembler.topics:
                return []
            self._define(type_name, definition)
            content = self._types.decode(payload, type_name)
            return self._finished(
                self._assembler.add(RosMessage(topic, type_name, logged_ns, content))
            )
        except (Undecodable, BadMessage, InvalidMap) as error:
            self.refused[topic] = self.refused.get(topic, 0) + 1
            self.reasons.setdefault(topic, str(error))
            return []

    def finish(self) -> list[Derived]:
        """End the recording: return the envelopes that still wait, made without what they lack."""
        return self._finished(self._assembler.finish())

    def _map(
        self, topic: str, type_name: str, logged_ns: int, payload: bytes
    ) -> list[Assembled | Derived]:
        if type_name != GRID_SCHEMA:
            raise BadMessage(f"it is {type_name:.80}, not {GRID_SCHEMA}")
        encoded = read_grid_message(payload, topic).encode()
        return self._assembler.put(Derived(MAP_KEY, None, encoded), logged_ns)

    def _define(self, type_name: str, definition: str) -> None:
        """Use the type definition that came with the messages."""
        if definition and self._defined.get(type_name) != definition:
            known = self._types.knows(type_name) and self._types.definition(type_name)
            if known != definition:
                self._types.define(type_name, definition)
            self._defined[type_name] = definition

    def _finished(self, ready: Iterable[Assembled | Derived]) -> list[Derived]:
        return [
            each if isinstance(each, Derived) else Derived(self._key, each.stamp_ns, each.payload)
            for each in ready
        ]


class LoggedEvent(Protocol):
    """The fields of a log's event that are used here."""

    @property
    def offset(self) -> int: ...
    @property
    def key(self) -> str: ...
    @property
    def logged_ns(self) -> int: ...
    @property
    def payload(self) -> bytes: ...


MessageOf = Callable[[Any], tuple[str, str] | None]
"""Returns type and definition of an event that is a ROS message in CDR, None for others."""


class DerivedFrom(NamedTuple):
    """A derived event, and the offset of the message that completed it; None for the end of its
    recording."""

    offset: int | None
    derived: Derived


def derive(
    events: Iterable[LoggedEvent], types: MessageTypes, message_of: MessageOf
) -> Iterator[DerivedFrom]:
    """Yield the envelopes and maps of all recordings among ``events``, in the order of the log.
    Raises LogDamaged for an event on ``mapfold/ros`` that cannot be read."""
    derivation: Derivation | None = None
    for event in events:
        if event.key == ROS_KEY:
            if derivation is not None:
                yield from (DerivedFrom(None, each) for each in derivation.finish())
            recording = recording_of(event)
            derivation = Derivation(recording, types) if recording.streams else None
        elif derivation is not None and (found := message_of(event)) is not None:
            made = derivation.add(event.key, *found, event.logged_ns, event.payload)
            yield from (DerivedFrom(event.offset, each) for each in made)
    if derivation is not None:
        yield from (DerivedFrom(None, each) for each in derivation.finish())


def recording_of(event: LoggedEvent) -> RosRecording:
    """The content of an event on ``mapfold/ros``. Raises LogDamaged."""
    try:
        return read_recording(event.payload)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise LogDamaged(
            f"the event on {ROS_KEY} at offset {event.offset} cannot be read: {reason}"
        ) from None


class _Identity(BaseModel):
    run_id: RunId
    keyframe_id: int


def identity_of(payload: bytes) -> tuple[str, int] | None:
    """Run and keyframe of an envelope's JSON; None if it has none."""
    try:
        found = _Identity.model_validate_json(payload)
    except ValidationError:
        return None
    return found.run_id, found.keyframe_id
