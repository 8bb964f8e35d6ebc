"""Derive envelopes and maps from the ROS messages in a log: a pure function of its events.

An event on ``mapfold/ros`` begins a recording: it names the topics, their uses and the run of the
keyframes. Each verbatim message behind it is added to the `Derivation` with its log time, and
completes none, one or several envelopes. The next event on ``mapfold/ros`` ends the recording:
envelopes that still wait are then made without what they lack.

The recorder derives while it records, and appends each envelope right behind the message that
completed it. So readers of the log need no ROS types, and get the same numbers on every machine.
A log's messages are derived again for the recorder that follows a killed one (`derive` in
`eventsrc.record.recorder.bridged`).
"""

import json
from collections.abc import Iterable, Sequence
from typing import Annotated, Final, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from eventsrc.envelope.crops import Crop
from eventsrc.envelope.grid_messages import GRID_SCHEMA, read_grid_message
from eventsrc.envelope.occupancy_map import InvalidMap
from eventsrc.envelope.system_events import MAP_KEY

from .assembler import Assembled, Assembler, RosMessage
from .library import MessageTypes, Undecodable
from .messages import BadMessage
from .pictures import CutCrops
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
    ``stamp_ns`` is the stamp of the detections; None for a map. ``crops`` are theirs, if they are
    kept."""

    key: str
    stamp_ns: int | None
    payload: bytes
    crops: Sequence[Crop] = ()


class Derivation:
    """Makes the envelopes and maps of one recording from its messages, in the order of the log, and
    crops of detections with ``cut``."""

    def __init__(
        self, recording: RosRecording, types: MessageTypes, cut: CutCrops | None = None
    ) -> None:
        self._key = recording.key
        self._grids = frozenset(recording.grids)
        self._assembler: Assembler[Derived] = Assembler(recording.streams, cut)
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
    def pictures(self) -> frozenset[str]:
        """The topics of pictures, whose messages go to `add_picture`."""
        return self._assembler.pictures

    def add_picture(self, topic: str, logged_ns: int, payload: bytes) -> list[Derived]:
        """Add a picture in CDR; return the envelopes and maps that are ready."""
        return self._finished(self._assembler.add(RosMessage(topic, "", logged_ns, payload)))

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
            each
            if isinstance(each, Derived)
            else Derived(self._key, each.stamp_ns, each.payload, each.crops)
            for each in ready
        ]
