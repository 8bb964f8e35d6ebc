"""Record messages of ROS verbatim, of a zenoh-bridge-ros2dds or of nodes over rmw_zenoh, and the
envelopes that they complete.

Zenoh's threads put messages into the queue and note tokens of types. The writer thread
gives the messages to `Bridge.take`, which finds the type of each and returns what is to be
appended: the message with its schema, and right behind it the envelopes that it completes
(`eventsrc.ros`). A message whose type no token has given yet is held back, for at most `HOLD_NS`
and within `HOLD_MESSAGES` and `HOLD_BYTES`; then it is kept without a schema, and no envelope is
made of it. Messages of one topic keep their order. Only messages under keys of no topic are left
out; they are counted.

After a kill: a recorder may have written a message and not yet what it completes, and detections
that waited for a pose were not made into an envelope at all. Both follow from the messages in the
log (`eventsrc.ros.derivation`), so the next recorder appends them before it records
(`append_missing`). It must read the last recording's messages once; after a regular end there is
nothing to do. A recording that has lost events to damage is left as it is.

In a log that drops classes (`eventsrc.envelope.dropped_classes`) messages of detections, embeddings
and pictures are read and not kept, so that after a kill nothing can be made of them.
"""

import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Final, NamedTuple

import msgspec
from pydantic import ValidationError

from eventsrc.base.errors import LogDamaged
from eventsrc.envelope.crops import CROPS_TOPIC, encode_crop
from eventsrc.envelope.dropped_classes import ClassDropper
from eventsrc.envelope.model import ENVELOPE_VERSION, Offset
from eventsrc.envelope.system_events import LOSS_KEY, MAP_KEY, ROS_KEY
from eventsrc.log import Event, LogReader, LogWriter, MessageFormat, VerbatimEvent
from eventsrc.record.append import CROP_FORMAT, NOTHING_DROPPED, append_payload, map_event
from eventsrc.record.gap_history import keyframe_of, loss_of
from eventsrc.record.transport.session import Received, SequenceNumber
from eventsrc.ros.derivation import CDR, ROS2MSG, Derivation, Derived, RosRecording, read_recording
from eventsrc.ros.library import MessageTypes, Undecodable
from eventsrc.ros.pictures import CutCrops
from eventsrc.ros.stream import Counts
from eventsrc.ros.wire import BridgeWire, Wire

from .checking import CheckedMessage
from .queue import BridgedMessage

HOLD_NS: Final = 10_000_000_000
HOLD_MESSAGES: Final = 4_096
HOLD_BYTES: Final = 32 * 1024 * 1024
MAX_KEYS: Final = 1_000
"""Keys of a topic, one for each type and hash."""
MAX_KEPT_NUMBERS: Final = 4_096
_UNKNOWN: Final = MessageFormat(CDR)

CheckEnvelope = Callable[[Sequence[Received]], Iterator[CheckedMessage]]


class _Held(NamedTuple):
    received_ns: int
    key: str
    payload: bytes


class Bridge:
    """The topics that are recorded of a bridge, or of nodes, with the types and held messages of
    each. ``wire`` is how their messages come.

    Only the writer thread changes it, except by `note_token`. ``topics`` are all that are recorded,
    also those from which ``recording`` makes no envelope. ``cut`` cuts the crops of detections that
    are kept, None for none; pictures are kept only of ``topics``.
    """

    def __init__(
        self,
        recording: RosRecording,
        topics: Collection[str],
        types: MessageTypes,
        wire: Wire | None = None,
        cut: CutCrops | None = None,
        dropper: ClassDropper[CheckedMessage] | None = None,
    ) -> None:
        self._dropper = ClassDropper[CheckedMessage]() if dropper is None else dropper
        self.recording = recording
        self.wire: Wire = wire or BridgeWire()
        self.derivation = Derivation(recording, types, cut)
        streams = recording.streams if dropper else ()
        showing = {t for s in streams for t in (s.detections, s.embeddings, s.images)}
        self._kept = frozenset(topics) - showing
        self.topics = tuple(dict.fromkeys([*topics, *sorted(self.derivation.pictures)]))
        self.keys = tuple(map(self.wire.key, self.topics))
        self._topics: dict[str, str] = {}
        self._key_counts = Counter[str]()
        self._types = types
        self._lock = threading.Lock()
        self._new_types: dict[str, str] = {}
        self._latched: set[str] = set()
        self._new_latched: set[str] = set()
        self._kept_numbers: dict[tuple[SequenceNumber, int], None] = {}
        self._formats: dict[str, MessageFormat] = {}
        self._undefined: dict[str, str] = {}
        """Why messages of a key cannot be read, though their type is known by name."""
        self._unread: dict[str, tuple[int, str]] = {}
        self._held: deque[_Held] = deque()
        self._held_bytes = 0
        self.untyped = 0
        """Messages kept without a schema, since their type is not known."""
        self.unknown_keys = 0
        """Messages left out, since their keys belong to no recorded topic."""

    @property
    def unread(self) -> tuple[tuple[str, int, str], ...]:
        """Topics whose messages are kept but cannot be read, how many, and why the first cannot."""
        refused, reasons = self.derivation.refused, self.derivation.reasons
        unread = ((topic, count, reasons.get(topic, "")) for topic, count in [*refused.items()])
        return *unread, *((topic, *why) for topic, why in [*self._unread.items()])

    @property
    def streams(self) -> tuple[tuple[str, Counts], ...]:
        """Copies of the counts of envelopes made, by topic of detections: the writer thread goes on
        counting."""
        return tuple(
            (topic, replace(counts, unused=dict(counts.unused), reasons=dict(counts.reasons)))
            for topic, counts in self.derivation.counts.items()
        )

    @property
    def types_known(self) -> frozenset[str]:
        """The keys whose types are known; may be called from any thread."""
        with self._lock:
            return frozenset(self._formats) | frozenset(self._new_types)

    @property
    def latched_topics(self) -> tuple[str, ...]:
        """Topics whose last messages a publisher may keep for late subscribers. Without detections,
        their embeddings and pictures: those kept are older than this recording."""
        live = {t for s in self.recording.streams for t in (s.detections, s.embeddings, s.images)}
        return tuple(topic for topic in self.topics if topic not in live)

    def take_new_latched(self) -> list[str]:
        """The topics in `latched_topics` that a new publisher keeps messages of, each once; may be
        called from any thread."""
        with self._lock:
            found, self._new_latched = self._new_latched, set()
        return [topic for topic in self.latched_topics if topic in found]

    @property
    def held(self) -> int:
        """Messages that wait for their type."""
        return len(self._held)

    def note_token(self, token: str) -> None:
        """Note what the token of a publisher says; called by Zenoh's threads."""
        found = self.wire.read_token(token)
        if found is not None and found.topic in self.topics:
            with self._lock:
                self._new_types[self.wire.key(found.topic)] = found.type_name
                if found.is_latched:
                    self._latched.add(found.topic)
                    self._new_latched.add(found.topic)

    def take(
        self, messages: Sequence[BridgedMessage], logged_ns: int, check: CheckEnvelope
    ) -> list[CheckedMessage]:
        """The messages to append at ``logged_ns``: these, and those held back whose type is known
        by now or whose time is over, each with what it completes."""
        self._store_new_types()
        taken = [*self._release(logged_ns, check)] if self._held else []
        waiting = {held.key for held in self._held}
        for message in messages:
            key, payload = message.key, message.payload
            if key not in self._topics and not self._know(key):
                self.unknown_keys += 1
                continue
            if message.number is not None and self._is_kept_already(message):
                continue
            if self._topics[key] in self.derivation.pictures:
                for derived in self.derivation.add_picture(self._topics[key], logged_ns, payload):
                    taken += self._checked(derived, check)
                if self._topics[key] not in self._kept:
                    continue
            if key in self._formats and key not in waiting:
                taken += self._appended(key, payload, logged_ns, check)
            else:
                waiting.add(key)
                self._hold(_Held(logged_ns, key, payload))
        while len(self._held) > HOLD_MESSAGES or self._held_bytes > HOLD_BYTES:
            taken += self._give_up(self._next_held(), logged_ns, check)
        return taken

    def finish(self, logged_ns: int, check: CheckEnvelope) -> list[CheckedMessage]:
        """The messages still to be appended when the recording ends."""
        taken = self.take((), logged_ns, check)
        while self._held:
            taken += self._give_up(self._next_held(), logged_ns, check)
        for derived in self.derivation.finish():
            taken += self._checked(derived, check)
        return taken

    def _know(self, key: str) -> bool:
        """Find the topic of a key, and the type if the key says it; whether it is recorded. Made-up
        types of one topic do not fill the memory, and are no loss for another."""
        parts = self.wire.read_key(key)
        if parts is None or parts.topic not in self.topics:
            return False
        self._key_counts[parts.topic] += 1
        if self._key_counts[parts.topic] > MAX_KEYS:
            return False
        self._topics[key] = parts.topic
        if parts.type_name is not None:
            with self._lock:
                self._formats[key] = self._format(parts.type_name, parts.type_hash, key)
        return True

    def _is_kept_already(self, message: BridgedMessage) -> bool:
        """Whether a message that its publisher keeps came before: both sent, and fetched."""
        number, kept = message.number, self._kept_numbers
        if number is None or self._topics[message.key] not in self._latched:
            return False
        sent = number, hash(message.payload)
        known = sent in kept
        kept[sent] = None
        if len(kept) > MAX_KEPT_NUMBERS:
            del kept[next(iter(kept))]
        return known

    def _store_new_types(self) -> None:
        """Make a format of each type that tokens gave since the last call."""
        with self._lock:
            new_types, self._new_types = self._new_types, {}
            for key, type_name in new_types.items():
                self._formats[key] = self._format(type_name, None, key)

    def _format(self, type_name: str, type_hash: str | None, key: str) -> MessageFormat:
        """The format of messages of a type, with its definition if that is known."""
        try:
            text = self._types.definition(type_name, type_hash).encode()
        except Undecodable as error:
            if self._types.knows(type_name):
                self._undefined[key] = str(error)
            return MessageFormat(CDR, type_name)
        return MessageFormat(CDR, type_name, ROS2MSG, text)

    def _hold(self, message: _Held) -> None:
        self._held.append(message)
        self._held_bytes += len(message.payload)

    def _next_held(self) -> _Held:
        message = self._held.popleft()
        self._held_bytes -= len(message.payload)
        return message

    def _release(self, now_ns: int, check: CheckEnvelope) -> Iterator[CheckedMessage]:
        for _ in range(len(self._held)):
            message = self._next_held()
            if message.key in self._formats:
                yield from self._appended(message.key, message.payload, now_ns, check)
            elif abs(now_ns - message.received_ns) > HOLD_NS:  # also where the clock was set
                yield from self._give_up(message, now_ns, check)
            else:
                self._hold(message)

    def _give_up(
        self, message: _Held, logged_ns: int, check: CheckEnvelope
    ) -> Iterator[CheckedMessage]:
        self.untyped += message.key not in self._formats
        yield from self._appended(message.key, message.payload, logged_ns, check)

    def _appended(
        self, key: str, payload: bytes, logged_ns: int, check: CheckEnvelope
    ) -> Iterator[CheckedMessage]:
        topic, form = self._topics[key], self._formats.get(key, _UNKNOWN)
        if topic in self._kept:
            yield CheckedMessage(topic, payload, ENVELOPE_VERSION, None, form=form)
        if topic in self.derivation.pictures:
            return
        if key in self._undefined:
            count, reason = self._unread.get(topic, (0, self._undefined[key]))
            self._unread[topic] = count + 1, reason
        elif form.schema:  # without a known definition no envelope is made, which is counted
            definition = form.schema_text.decode()
            made = self.derivation.add(topic, form.schema, definition, logged_ns, payload)
            for derived in made:
                yield from self._checked(derived, check)

    def _checked(self, derived: Derived, check: CheckEnvelope) -> Iterator[CheckedMessage]:
        """The messages of an event: an envelope and its crops, or a map."""
        if derived.key == MAP_KEY:
            yield CheckedMessage(MAP_KEY, derived.payload, ENVELOPE_VERSION, None)
            return
        for message in check([Received(derived.key, derived.payload)]):
            # no robot sent it, so none is answered
            yield msgspec.structs.replace(message, sha256="")
        for crop in derived.crops:
            kept = encode_crop(crop, derived.stamp_ns or 0)
            made = CheckedMessage(CROPS_TOPIC, kept, ENVELOPE_VERSION, None, form=CROP_FORMAT)
            yield from self._dropper.crop(crop.det_id, made, len(kept))


def append_missing(
    reader: LogReader,
    writer: LogWriter,
    types: MessageTypes,
    dropper: ClassDropper[Any] = NOTHING_DROPPED,
) -> int:
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
            append_payload(writer, derived.key, derived.payload, dropper=dropper)
    writer.append(ROS_KEY, RosRecording(key=recording.key).encode())
    writer.sync()
    return len(missing)


def _message_of(event: Event) -> tuple[str, str] | None:
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
            if event.key == LOSS_KEY and (loss := loss_of(event)) is not None:
                # if a message of ROS was lost, the keyframes after it would get other numbers
                has_losses = has_losses or loss.cause == "rot"
            if event.key == MAP_KEY and maps:
                maps.popleft()
            elif event.is_envelope:
                made.pop(keyframe_of(event.payload), None)
            yield event

    for _, derived in derive(watched(), types):
        if derived.key == MAP_KEY:
            maps.append(derived)
        else:
            made[keyframe_of(derived.payload)] = derived
    return [] if has_losses else [*maps, *made.values()]


class DerivedFrom(NamedTuple):
    """A derived event, and the offset of the message that completed it; None for the end of its
    recording."""

    offset: int | None
    derived: Derived


def derive(events: Iterable[Event], types: MessageTypes) -> Iterator[DerivedFrom]:
    """Yield the envelopes and maps of all recordings among ``events``, in the order of the log.
    Raises LogDamaged for an event on ``mapfold/ros`` that cannot be read."""
    derivation: Derivation | None = None
    for event in events:
        if event.key == ROS_KEY:
            if derivation is not None:
                yield from (DerivedFrom(None, each) for each in derivation.finish())
            recording = recording_of(event)
            derivation = Derivation(recording, types) if recording.streams else None
        elif derivation is not None and (found := _message_of(event)) is not None:
            made = derivation.add(event.key, *found, event.logged_ns, event.payload)
            yield from (DerivedFrom(event.offset, each) for each in made)
    if derivation is not None:
        yield from (DerivedFrom(None, each) for each in derivation.finish())


def recording_of(event: Event) -> RosRecording:
    """The content of an event on ``mapfold/ros``. Raises LogDamaged."""
    try:
        return read_recording(event.payload)
    except ValidationError as error:
        reason = error.errors()[0]["msg"]
        raise LogDamaged(
            f"the event on {ROS_KEY} at offset {event.offset} cannot be read: {reason}"
        ) from None
