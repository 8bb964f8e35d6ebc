"""Assemble envelopes from decoded ROS messages, given in the order in which they were received.

Each message of a stream's detections becomes one envelope, a keyframe with the next number of its
run. It waits for its pose, camera, embeddings and names of classes, at most until a message was
received ``wait_ns`` after it or ``max_waiting`` others wait behind it; then it is made without
those missing. Output has the order of the input. There is no clock and no chance: equal messages
make equal envelopes.
"""

import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, TypeVar

import msgspec

from eventsrc.envelope.crops import Crop

from . import messages
from .measured import KeptScans, place_solids
from .named_classes import ClassNames
from .pictures import CutCrops, Jpegs, StreamPictures
from .stream import Counts, PicturePose, PoseSource, Stream
from .transforms import TransformBuffer

_MOST_EMBEDDINGS: Final = 1_000
"""Bound of the messages of embeddings kept for detections that have not been received."""
_UNCLAIMED: Final = "no detections of its stamp came, or they came too late"
_NS: Final = 1_000_000_000

Item = TypeVar("Item")


class RosMessage(NamedTuple):
    """A decoded message. ``type_name`` is such as ``tf2_msgs/msg/TFMessage``; ``received_ns`` is
    the time of receipt, in a bag its log time; ``content`` has the attributes of the type. Of a
    picture it is the bytes of the message."""

    topic: str
    type_name: str
    received_ns: int
    content: Any


class Assembled(NamedTuple):
    """The JSON of an envelope, and the crops of its detections if they are kept. ``topic`` and
    ``received_ns`` are those of its detections."""

    topic: str
    received_ns: int
    stamp_ns: int
    payload: bytes
    crops: Sequence[Crop] = ()


@dataclass(slots=True)
class _Picture:
    """Detections of one picture that wait for their pose, camera and embeddings."""

    received_ns: int
    state: "_StreamState"
    detected: messages.Detected
    keyframe_id: int
    pose: PicturePose | None = None
    checked_at: int = -1
    """`PoseSource.received` when the pose was looked up last."""
    jpegs: Jpegs | None = None
    """The crop of each detection; None without a picture so far."""


@dataclass(slots=True)
class _Passed(Generic[Item]):
    """An item given to `Assembler.put`, in the queue to keep its place in the order."""

    received_ns: int
    item: Item


class Assembler(Generic[Item]):
    """Makes envelopes of messages. An ``Item`` given to `put` is returned unchanged, in its place
    in the order. Crops of detections are made by ``cut``, without it none."""

    def __init__(self, streams: Iterable[Stream], cut: CutCrops | None = None) -> None:
        self.pictures: frozenset[str] = frozenset()
        """The topics of pictures."""
        self._queue: deque[_Picture | _Passed[Item]] = deque()
        self._states: dict[str, _StreamState] = {}
        self._handlers: dict[str, list[_Handler]] = {}
        self._latest_ns: int | None = None
        buffers: dict[tuple[str | None, str | None, int], TransformBuffer] = {}
        for stream in streams:
            key = stream.tf, stream.tf_static, stream.max_gap_ns
            is_first = key not in buffers
            buffer = buffers.setdefault(key, TransformBuffer(stream.max_gap_ns))
            state = _StreamState(stream, buffer, cut, shares_transforms=not is_first)
            if cut is not None and stream.images is not None:
                self.pictures |= {stream.images}
            self._states[stream.detections] = state
            for topic, handler in state.handlers(with_transforms=is_first).items():
                self._handlers.setdefault(topic, []).append(handler)

    @property
    def topics(self) -> frozenset[str]:
        """The topics of which messages are used."""
        return frozenset(self._states) | frozenset(self._handlers)

    @property
    def counts(self) -> dict[str, Counts]:
        """The counts of each stream, by topic of detections. Transforms that several streams use
        are counted for the first of them."""
        return {topic: state.counts for topic, state in self._states.items()}

    def frames(self) -> dict[str, str | None]:
        """The frame of the poses of each stream, by topic of detections; None if still unknown."""
        return {topic: state.poses.frame for topic, state in self._states.items()}

    def add(self, message: RosMessage) -> list[Assembled | Item]:
        """Process a message; return the envelopes and items that are ready.

        Raises BadMessage for detections that do not fit their type, of which no keyframe is made.
        Any other message that cannot be used is counted.
        """
        topic, type_name, received_ns, content = message
        self._advance(received_ns)
        for handler in self._handlers.get(topic, ()):
            handler(topic, type_name, content)
        state = self._states.get(topic)
        if state is not None:
            self._queue.append(state.picture(type_name, received_ns, content))
        return self._ready() if self._queue else []

    def put(self, item: Item, received_ns: int) -> list[Assembled | Item]:
        """Queue ``item`` behind all that was given before; return the envelopes and items that are
        ready."""
        self._advance(received_ns)
        self._queue.append(_Passed(received_ns, item))
        return self._ready()

    def finish(self) -> list[Assembled | Item]:
        """End the input: return all waiting envelopes, made without what they lack, and items."""
        rest = [self._pop_first() for _ in range(len(self._queue))]
        for state in self._states.values():
            state.count_unclaimed()
        return rest

    def _advance(self, received_ns: int) -> None:
        if self._latest_ns is None or received_ns > self._latest_ns:
            self._latest_ns = received_ns

    def _ready(self) -> list[Assembled | Item]:
        ready: list[Assembled | Item] = []
        while self._queue and self._is_due(self._queue[0]):
            ready.append(self._pop_first())
        return ready

    def _is_due(self, first: _Picture | _Passed[Item]) -> bool:
        if isinstance(first, _Passed):
            return True
        stream = first.state.stream
        late = self._latest_ns is not None and self._latest_ns - first.received_ns > stream.wait_ns
        return late or len(self._queue) > stream.max_waiting or first.state.has_all(first)

    def _pop_first(self) -> Assembled | Item:
        first = self._queue.popleft()
        return first.item if isinstance(first, _Passed) else first.state.envelope(first)


_Handler = Callable[[str, str, Any], None]


class _StreamState:
    """The state of one stream."""

    def __init__(
        self,
        stream: Stream,
        buffer: TransformBuffer,
        cut: CutCrops | None,
        *,
        shares_transforms: bool,
    ) -> None:
        self.stream = stream
        self._shares_transforms = shares_transforms
        self.counts = Counts()
        self._pictures: StreamPictures | None = None
        if cut is not None and stream.images is not None:
            self._pictures = StreamPictures(stream, cut, self.counts)
        self.poses = PoseSource(stream, buffer, self.counts)
        self._lens: messages.Lens | None = None
        self._names = ClassNames()
        self._told: Mapping[str, str] = {}
        self._embeddings: dict[int, messages.StampedEmbeddings] = {}
        self._scans = KeptScans()
        self._next = stream.first_keyframe

    def handlers(self, *, with_transforms: bool) -> dict[str, _Handler]:
        """The handler of each topic that the stream uses besides its detections."""
        stream = self.stream
        handlers: dict[str | None, _Handler] = {}
        if with_transforms:
            handlers |= dict.fromkeys((stream.tf, stream.tf_static), self.poses.add_transforms)
        handlers |= dict.fromkeys((stream.pose, stream.covariance), self.poses.add_pose)
        handlers |= {stream.camera: self._set_lens, stream.embeddings: self._keep_embeddings}
        handlers |= dict.fromkeys(stream.classes, self._add_names)
        handlers[stream.scan] = self._scans.add
        if self._pictures is not None:
            handlers[stream.images] = self._pictures.add
        return {
            topic: self._counting(handler)
            for topic, handler in handlers.items()
            if topic is not None
        }

    def _counting(self, handler: _Handler) -> _Handler:
        """``handler``, which counts a message instead of raising BadMessage."""

        def counting(topic: str, type_name: str, content: Any) -> None:
            try:
                handler(topic, type_name, content)
            except messages.BadMessage as error:
                self.counts.refuse(topic, str(error))

        return counting

    def picture(self, type_name: str, received_ns: int, content: Any) -> _Picture:
        """The detections of a message, with the next keyframe id. Raises BadMessage."""
        if type_name not in messages.DETECTION_TYPES:
            raise messages.BadMessage(
                f"it is {type_name:.80}, not {' or '.join(messages.DETECTION_TYPES)}"
            )
        detected = messages.read(messages.detections_of, content)
        self._next += 1
        jpegs = None if self._pictures is None else self._pictures.cut(detected)
        return _Picture(received_ns, self, detected, self._next - 1, jpegs=jpegs)

    def has_all(self, picture: _Picture) -> bool:
        """Whether everything that the stream has topics for is there; looks up the pose."""
        if picture.pose is None and self.stream.has_poses:
            if picture.checked_at == self.poses.received and not self._shares_transforms:
                return False
            picture.checked_at = self.poses.received
            detected = picture.detected
            picture.pose = self.poses.at(detected.stamp_ns, detected.frame, final=False)
            if picture.pose is None:
                return False
        stream = self.stream
        if stream.camera is not None and self._lens is None:
            return False
        if stream.classes and not self._told:
            return False
        if stream.scan is not None and not self._scans.reach(picture.detected.stamp_ns):
            return False
        return stream.embeddings is None or picture.detected.stamp_ns in self._embeddings

    def envelope(self, picture: _Picture) -> Assembled:
        """The envelope of the detections, with as much of the rest as is there."""
        stream, counts, detected = self.stream, self.counts, picture.detected
        counts.keyframes += 1
        counts.detections += len(detected.detections)
        counts.unclassified += detected.unclassified
        document: dict[str, Any] = {
            "run_id": stream.run_id,
            "keyframe_id": picture.keyframe_id,
            "timestamp": detected.stamp_ns / _NS,
        }
        pose = picture.pose or self.poses.at(detected.stamp_ns, detected.frame, final=True)
        if pose is None:
            counts.without_pose += 1
        else:
            document |= self._pose_fields(pose)
            scan = self._scans.at(detected.stamp_ns, pose, self.poses)
            if scan is not None:
                document["scan"] = scan
                counts.with_scan += 1
        lens = self._lens
        if lens is not None and not detected.has_boxes and lens.frame != detected.frame:
            lens = None  # things in the frame of a lidar, say
        counts.with_position += place_solids(detected, pose, lens)
        if lens is None:
            counts.without_camera += 1
        else:
            document["camera"] = {
                "hfov_deg": lens.hfov_deg,
                "width_px": lens.width_px,
                "height_px": lens.height_px,
                "yaw_rad": 0.0 if pose is None else pose.camera_yaw,
            }
        self._name_classes(detected)
        self._attach_embeddings(detected)
        document["detections"] = detected.detections
        made = stream.detections, picture.received_ns, detected.stamp_ns, _encode(document)
        if self._pictures is None:
            return Assembled(*made)
        return Assembled(*made, self._pictures.crops(picture.keyframe_id, detected, picture.jpegs))

    def _pose_fields(self, pose: PicturePose) -> dict[str, Any]:
        counts = self.counts
        counts.without_camera_frame += pose.camera is None
        counts.without_base_frame += not pose.has_base
        fields: dict[str, Any] = {"map_x": pose.x, "map_y": pose.y, "map_yaw": pose.yaw}
        if self.stream.heights:
            fields["map_z"] = pose.z
        if pose.covariance is None:
            counts.without_covariance += 1
        else:
            fields["pose_covariance"] = list(pose.covariance)
        return fields

    def _name_classes(self, detected: messages.Detected) -> None:
        given, told = self.stream.labels, self._told
        for detection in detected.detections:
            class_id = detection["class"]
            if class_id != messages.UNCLASSIFIED:
                detection["class"] = given.get(class_id) or told.get(class_id, class_id)
            self.counts.numbered += detection["class"].isdecimal()

    def _add_names(self, _topic: str, type_name: str, content: Any) -> None:
        if self._names.add(type_name, content):
            self._told = self._names.of(self.stream.detections).labels

    def _attach_embeddings(self, detected: messages.Detected) -> None:
        given = self._embeddings.pop(detected.stamp_ns, None)
        if given is None:
            return
        texts = given.by_index
        if given.by_id is not None:
            texts = [given.by_id.get(name) for name in detected.ids]
            known = frozenset(detected.ids)
            for name, text in given.by_id.items():
                if text is not None and name not in known:
                    reason = f"an embedding of {name!r:.80}, which is the id of no detection"
                    self.counts.refuse(self.stream.embeddings or "", reason)
        if len(texts) != len(detected.detections):
            reason = f"{len(texts)} embeddings for {len(detected.detections)} detections"
            self.counts.refuse(self.stream.embeddings or "", reason)
            return
        model = given.model or self.stream.embedding_model
        for detection, text in zip(detected.detections, texts, strict=True):
            if text is not None:
                self.counts.with_embedding += 1
                detection["embedding"] = text
                detection["embedding_dim"] = given.dim or _dimension(text)
                if model is not None:
                    detection["embedding_model"] = model

    def _set_lens(self, _topic: str, type_name: str, content: Any) -> None:
        if type_name != messages.CAMERA_INFO:
            raise messages.BadMessage(f"it is {type_name:.80}, not {messages.CAMERA_INFO}")
        self._lens = messages.read(messages.lens_of, content)

    def _keep_embeddings(self, topic: str, type_name: str, content: Any) -> None:
        reader = {
            messages.TEXT: messages.embeddings_of_text,
            messages.FLOATS: messages.embeddings_of_floats,
        }.get(type_name)
        if reader is None:
            raise messages.BadMessage(
                f"it is {type_name:.80}, not {messages.TEXT} or {messages.FLOATS}"
            )
        given = messages.read(reader, content)
        if len(self._embeddings) >= _MOST_EMBEDDINGS:
            del self._embeddings[next(iter(self._embeddings))]
            self.counts.refuse(topic, _UNCLAIMED)
        if given.stamp_ns in self._embeddings:
            raise messages.BadMessage("there were others of its stamp before")
        self._embeddings[given.stamp_ns] = given

    def count_unclaimed(self) -> None:
        """Count the embeddings whose detections never came."""
        for _ in self._embeddings:
            self.counts.refuse(self.stream.embeddings or "", _UNCLAIMED)
        self._embeddings.clear()


def _encode(document: dict[str, Any]) -> bytes:
    """JSON with NaN and infinity as Python writes them, so that validation rejects the envelope and
    names the field."""
    try:
        payload = msgspec.json.encode(document)
    except (UnicodeError, ValueError):  # a lone surrogate
        payload = b"null"
    if b"null" not in payload:  # what msgspec makes of NaN and infinity
        return payload
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    return text.encode(errors="backslashreplace")


def _dimension(text: str) -> int:
    """The number of float32 in a base64 text, rounded down."""
    return max(len(text.rstrip("=")) * 3 // 16, 1)
