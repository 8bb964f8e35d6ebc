"""Import a rosbag2: its detections as envelopes, its occupancy grids as maps."""

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.crops import CROPS_TOPIC, encode_crop
from eventsrc.envelope.grid_messages import read_grid_message
from eventsrc.envelope.occupancy_map import InvalidMap
from eventsrc.envelope.system_events import Excerpt
from eventsrc.record.append import CROP_FORMAT
from eventsrc.ros.assembler import Assembled, Assembler, RosMessage
from eventsrc.ros.library import MessageTypes, Undecodable
from eventsrc.ros.messages import DETECTION_TYPES, FLOATS, TEXT, BadMessage
from eventsrc.ros.stream import Counts

from .bag_files import Bag, BagContents, BagMessage, bag_name, sampled
from .bag_streams import BagOptions, Choice, Chooser
from .sources import ImportedMessage, Source


@dataclass(frozen=True)
class BagTopicReport:
    """A topic of a bag, its number of messages, and their use; empty if unused."""

    topic: str
    type: str
    messages: int
    used_for: str


@dataclass
class BagReport:
    """The topics of a bag and what was imported. ``streams`` are the counts by topic of
    detections."""

    name: str
    messages: int
    duration_s: float
    topics: list[BagTopicReport] = field(default_factory=list)
    streams: dict[str, Counts] = field(default_factory=dict)
    frames: dict[str, str | None] = field(default_factory=dict)
    """The frame of the poses of each stream, by topic of detections."""
    unchanged_grids: int = 0
    """Number of occupancy grids left out because they equal the one before on their topic."""
    notes: list[str] = field(default_factory=list)

    is_useless: bool = False
    """Whether nothing of the bag can be imported: no detections, no occupancy grid."""


class RosBag(Source):
    """A bag of ROS 2 as a source. Messages are read when `messages` is called."""

    def __init__(self, path: Path, files: ExitStack, options: BagOptions) -> None:
        self._bag = Bag(path, files)
        super().__init__(str(path), self._bag.size_bytes)
        self.report: BagReport | None = None
        self._path = path
        self._options = options
        self._types = MessageTypes()
        self._known: dict[str, bytes] = {}
        self._numbers: deque[int] = deque()

    def bytes_read(self) -> int:
        """An estimate of the bytes read so far."""
        return self._bag.bytes_read()

    def messages(self) -> Iterator[ImportedMessage]:
        """Envelopes and maps, in the order in which detections and grids were received."""
        contents = self._bag.scan(sampled)
        notes = self._define(contents)
        name = bag_name(self._path)
        choice = Chooser(name, contents, self._types, self._options).choose()
        report = self.report = _report(self.name, contents, choice)
        report.notes = [*notes, *report.notes]
        assembler: Assembler[ImportedMessage] = Assembler(choice.streams, self._options.cut)
        report.streams = assembler.counts
        wanted = {topic for topic in choice.uses if topic in contents.topics}
        self.skipped = contents.count - sum(contents.topics[topic].count for topic in wanted)
        damage: MapfoldError | None = None
        try:
            yield from self._assemble(assembler, wanted, {*choice.grids}, report)
        except MapfoldError as error:
            damage = error
        for each in assembler.finish():
            yield from self._imported(each)
        report.frames = assembler.frames()
        if damage is not None:
            raise damage

    def _assemble(
        self,
        assembler: Assembler[ImportedMessage],
        wanted: set[str],
        grids: set[str],
        report: BagReport,
    ) -> Iterator[ImportedMessage]:
        decode, add, put = self._types.decode, assembler.add, assembler.put
        detections = assembler.counts.keys()
        for number, message in enumerate(self._bag.messages(wanted), 1):
            topic, type_name, received_ns, payload, refused = message
            if topic in assembler.pictures:
                ready = self._picture(assembler, message, report)
            elif isinstance(payload, Excerpt) or refused is not None:
                self._numbers.append(number)
                ready = put(_refused(payload, topic, received_ns, refused or ""), received_ns)
            elif topic in grids:
                grid = self._grid(topic, received_ns, payload, report)
                if grid is None:
                    continue
                self._numbers.append(number)
                ready = put(grid, received_ns)
            else:
                try:
                    content = decode(payload, type_name)
                    ready = add(RosMessage(topic, type_name, received_ns, content))
                    if topic in detections:
                        self._numbers.append(number)
                except (Undecodable, BadMessage) as error:
                    self._numbers.append(number)
                    ready = put(_refused(payload, topic, received_ns, str(error)), received_ns)
            for each in ready:
                yield from self._imported(each)

    def _imported(self, each: Assembled | ImportedMessage) -> Iterator[ImportedMessage]:
        """An output of the assembler as a message, behind it those of its crops; sets `at` to the
        number of its source."""
        self.at = self._numbers.popleft()
        if isinstance(each, ImportedMessage):
            yield each
            return
        yield ImportedMessage(each.payload, None, each.received_ns)
        for crop in each.crops:
            kept = encode_crop(crop, each.stamp_ns)
            yield ImportedMessage(
                kept, CROPS_TOPIC, each.received_ns, each.stamp_ns, form=CROP_FORMAT
            )

    def _picture(
        self, assembler: Assembler[ImportedMessage], message: BagMessage, report: BagReport
    ) -> list[Assembled | ImportedMessage]:
        """Add a picture; one that is too large is counted."""
        topic, type_name, received_ns, payload, refused = message
        if not isinstance(payload, Excerpt) and refused is None:
            return assembler.add(RosMessage(topic, type_name, received_ns, payload))
        for counts in report.streams.values():
            counts.refuse(topic, refused or "it is too large")
        return []

    def _grid(
        self, topic: str, received_ns: int, payload: bytes, report: BagReport
    ) -> ImportedMessage | None:
        """An occupancy grid; None if its map equals the one before on its topic."""
        try:
            map_ = read_grid_message(payload, topic)
            digest = bytes.fromhex(map_.digest())
        except InvalidMap as error:
            return _refused(payload, topic, received_ns, str(error))
        if self._known.get(topic) == digest:
            report.unchanged_grids += 1
            return None
        self._known[topic] = digest
        return ImportedMessage(payload, _key(topic), received_ns, is_grid=True)

    def _define(self, contents: BagContents) -> list[str]:
        """Define the types that may be used as the bag does; return notes on those that fail."""
        notes = []
        done = set()
        for topic in contents.topics.values():
            text, kind, name = topic.definition, topic.definition_encoding, topic.type_name
            if not text or name in done or not _may_be_used(name):
                continue
            done.add(name)
            try:
                self._types.define(name, text, is_idl=kind == "ros2idl")
            except Undecodable as error:
                notes.append(f"{error}; messages are read as ROS 2 defines them")
        return notes


def _may_be_used(type_name: str) -> bool:
    return type_name in (TEXT, FLOATS) or sampled(type_name, 0)


def _report(name: str, contents: BagContents, choice: Choice) -> BagReport:
    first, last = contents.first_ns, contents.last_ns
    duration = 0.0 if first is None or last is None else (last - first) / 1e9
    topics = [
        BagTopicReport(topic.name, topic.type_name, topic.count, choice.uses.get(topic.name, ""))
        for topic in sorted(contents.topics.values(), key=lambda each: each.name)
    ]
    notes = [*choice.notes]
    if contents.damage is not None:
        notes.append(f"damaged: {contents.damage}")
    is_useless = not choice.streams and not choice.grids
    if is_useless:
        types = sorted({topic.type_name for topic in contents.topics.values()})
        has = f"it has {', '.join(types[:8])}" if types else "it is empty"
        notes.append(
            f"nothing to import: no topic is of type {' or '.join(DETECTION_TYPES)}; {has}"
        )
    counted = name, contents.count, duration, topics
    return BagReport(*counted, notes=notes, is_useless=is_useless)


def _refused(
    payload: bytes | Excerpt, topic: str, received_ns: int, reason: str
) -> ImportedMessage:
    kept, excerpt = (b"", payload) if isinstance(payload, Excerpt) else (payload, None)
    refused = f"{topic}: {reason}"
    return ImportedMessage(kept, _key(topic), received_ns, refused=refused, excerpt=excerpt)


def _key(topic: str) -> str:
    return topic.strip("/") or "ros"
