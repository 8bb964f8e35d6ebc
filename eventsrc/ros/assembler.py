"""From decoded ROS messages, in the order in which they were received, to envelopes.

Each message of a stream's detections becomes one envelope, a keyframe with the next number of its
run. It waits for what it lacks, at most until a message was received ``wait_ns`` after it or
``max_waiting`` others wait behind it; then it is made without. What comes out keeps the order in
which it came in. There is no clock and no chance: the same messages make the same envelopes.
"""

import json
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final, Generic, NamedTuple, TypeVar

import msgspec

from .messages import (
    CAMERA_INFO,
    DETECTIONS,
    FLOATS,
    TEXT,
    BadMessage,
    Detected,
    Embeddings,
    Lens,
    detections_of,
    embeddings_of_floats,
    embeddings_of_text,
    lens_of,
    read,
)
from .poses import PicturePose, PoseSource
from .stream import Counts, Stream
from .transforms import TransformBuffer

_MOST_EMBEDDINGS: Final = 1_000
"""Messages of embeddings that are kept for detections that have not come yet."""
_UNCLAIMED: Final = "no detections of its stamp came, or they came too late"
_NS: Final = 1_000_000_000

Item = TypeVar("Item")


class RosMessage(NamedTuple):
    """A decoded message. ``type_name`` is such as ``tf2_msgs/msg/TFMessage``; ``received_ns`` is
    when it was received, the log time of a bag; ``content`` has the attributes of the type."""

    topic: str
    type_name: str
    received_ns: int
    content: Any


class Assembled(NamedTuple):
    """The JSON of an envelope. ``topic`` and ``received_ns`` are those of its detections."""

    topic: str
    received_ns: int
    stamp_ns: int
    payload: bytes


@dataclass(slots=True)
class _Picture:
    """Detections that wait for the rest."""

    received_ns: int
    track: "_Track"
    detected: Detected
    keyframe_id: int
    pose: PicturePose | None = None
    asked_at: int = -1
    """How many messages the source of poses had taken when it was asked last."""


@dataclass(slots=True)
class _Passed(Generic[Item]):
    """Something else that keeps its place in the order."""

    received_ns: int
    item: Item


class Assembler(Generic[Item]):
    """Makes envelopes of messages. An ``Item`` given to `put` comes out as it is, after what came
    before it."""

    def __init__(self, streams: Iterable[Stream]) -> None:
        self._queue: deque[_Picture | _Passed[Item]] = deque()
        self._tracks: dict[str, _Track] = {}
        self._takers: dict[str, list[_Taker]] = {}
        self._latest_ns: int | None = None
        buffers: dict[tuple[str | None, str | None, int], TransformBuffer] = {}
        for stream in streams:
            key = stream.tf, stream.tf_static, stream.max_gap_ns
            is_first = key not in buffers
            buffer = buffers.setdefault(key, TransformBuffer(stream.max_gap_ns))
            track = _Track(stream, buffer, shares_transforms=not is_first)
            self._tracks[stream.detections] = track
            for topic, taker in track.takers(with_transforms=is_first).items():
                self._takers.setdefault(topic, []).append(taker)

    @property
    def topics(self) -> frozenset[str]:
        """The topics of which messages are used."""
        return frozenset(self._tracks) | frozenset(self._takers)

    @property
    def counts(self) -> dict[str, Counts]:
        """By topic of detections. Transforms are counted where the first stream uses them."""
        return {topic: track.counts for topic, track in self._tracks.items()}

    def frames(self) -> dict[str, str | None]:
        """The frame of the poses by topic of detections; None where it is not known yet."""
        return {topic: track.poses.frame for topic, track in self._tracks.items()}

    def add(self, message: RosMessage) -> list[Assembled | Item]:
        """Take a message; returns what is ready now.

        Raises BadMessage for detections that are not what their type says: no keyframe is made of
        them. Any other message that cannot be used is counted.
        """
        topic, type_name, received_ns, content = message
        self._see(received_ns)
        for taker in self._takers.get(topic, ()):
            taker(topic, type_name, content)
        track = self._tracks.get(topic)
        if track is not None:
            self._queue.append(track.picture(type_name, received_ns, content))
        return self._ready() if self._queue else []

    def put(self, item: Item, received_ns: int) -> list[Assembled | Item]:
        """Pass ``item`` on, after what came before it; returns what is ready now."""
        self._see(received_ns)
        self._queue.append(_Passed(received_ns, item))
        return self._ready()

    def finish(self) -> list[Assembled | Item]:
        """What still waits, without what it waits for; no message comes any more."""
        rest = [self._take_first() for _ in range(len(self._queue))]
        for track in self._tracks.values():
            track.count_unclaimed()
        return rest

    def _see(self, received_ns: int) -> None:
        if self._latest_ns is None or received_ns > self._latest_ns:
            self._latest_ns = received_ns

    def _ready(self) -> list[Assembled | Item]:
        ready: list[Assembled | Item] = []
        while self._queue and self._is_due(self._queue[0]):
            ready.append(self._take_first())
        return ready

    def _is_due(self, first: _Picture | _Passed[Item]) -> bool:
        if isinstance(first, _Passed):
            return True
        stream = first.track.stream
        late = self._latest_ns is not None and self._latest_ns - first.received_ns > stream.wait_ns
        return late or len(self._queue) > stream.max_waiting or first.track.has_all(first)

    def _take_first(self) -> Assembled | Item:
        first = self._queue.popleft()
        return first.item if isinstance(first, _Passed) else first.track.envelope(first)


_Taker = Callable[[str, str, Any], None]


class _Track:
    """The state of one stream."""

    def __init__(self, stream: Stream, buffer: TransformBuffer, *, shares_transforms: bool) -> None:
        self.stream = stream
        self._shares_transforms = shares_transforms
        self.counts = Counts()
        self.poses = PoseSource(stream, buffer, self.counts)
        self._lens: Lens | None = None
        self._embeddings: dict[int, Embeddings] = {}
        self._next = stream.first_keyframe

    def takers(self, *, with_transforms: bool) -> dict[str, _Taker]:
        """What takes the messages of each topic that the stream listens to."""
        stream = self.stream
        takers: dict[str | None, _Taker] = {}
        if with_transforms:
            takers |= dict.fromkeys((stream.tf, stream.tf_static), self.poses.take_transforms)
        takers |= dict.fromkeys((stream.pose, stream.covariance), self.poses.take_pose)
        takers |= {stream.camera: self._take_lens, stream.embeddings: self._take_embeddings}
        return {topic: self._counting(take) for topic, take in takers.items() if topic is not None}

    def _counting(self, take: _Taker) -> _Taker:
        def counting(topic: str, type_name: str, content: Any) -> None:
            try:
                take(topic, type_name, content)
            except BadMessage as error:
                self.counts.refuse(topic, str(error))

        return counting

    def picture(self, type_name: str, received_ns: int, content: Any) -> _Picture:
        """Number the detections. Raises BadMessage."""
        if type_name != DETECTIONS:
            raise BadMessage(f"it is {type_name:.80}, not {DETECTIONS}")
        labels = self.stream.labels
        detected = read(lambda message: detections_of(message, labels), content)
        self._next += 1
        return _Picture(received_ns, self, detected, self._next - 1)

    def has_all(self, picture: _Picture) -> bool:
        """Whether it has everything that its stream has topics for."""
        if picture.pose is None and self.stream.has_poses:
            if picture.asked_at == self.poses.received and not self._shares_transforms:
                return False
            picture.asked_at = self.poses.received
            detected = picture.detected
            picture.pose = self.poses.at(detected.stamp_ns, detected.frame, final=False)
            if picture.pose is None:
                return False
        stream = self.stream
        if stream.camera is not None and self._lens is None:
            return False
        return stream.embeddings is None or picture.detected.stamp_ns in self._embeddings

    def envelope(self, picture: _Picture) -> Assembled:
        """The envelope, with what there is."""
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
        if self._lens is None:
            counts.without_camera += 1
        else:
            document["camera"] = {
                "hfov_deg": self._lens.hfov_deg,
                "width_px": self._lens.width_px,
                "height_px": self._lens.height_px,
                "yaw_rad": 0.0 if pose is None else pose.camera_yaw,
            }
        self._add_embeddings(detected)
        document["detections"] = detected.detections
        payload = _encode(document)
        return Assembled(stream.detections, picture.received_ns, detected.stamp_ns, payload)

    def _pose_fields(self, pose: PicturePose) -> dict[str, Any]:
        counts = self.counts
        counts.without_camera_frame += not pose.has_camera
        counts.without_base_frame += not pose.has_base
        fields: dict[str, Any] = {"map_x": pose.x, "map_y": pose.y, "map_yaw": pose.yaw}
        if self.stream.heights:
            fields["map_z"] = pose.z
        if pose.covariance is None:
            counts.without_covariance += 1
        else:
            fields["pose_covariance"] = list(pose.covariance)
        return fields

    def _add_embeddings(self, detected: Detected) -> None:
        given = self._embeddings.pop(detected.stamp_ns, None)
        if given is None:
            return
        texts = given.by_index
        if given.by_id is not None:
            texts = [given.by_id.get(name) for name in detected.ids]
            for name, text in given.by_id.items():
                if text is not None and name not in detected.ids:
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

    def _take_lens(self, _topic: str, type_name: str, content: Any) -> None:
        if type_name != CAMERA_INFO:
            raise BadMessage(f"it is {type_name:.80}, not {CAMERA_INFO}")
        self._lens = read(lens_of, content)

    def _take_embeddings(self, topic: str, type_name: str, content: Any) -> None:
        reader = {TEXT: embeddings_of_text, FLOATS: embeddings_of_floats}.get(type_name)
        if reader is None:
            raise BadMessage(f"it is {type_name:.80}, not {TEXT} or {FLOATS}")
        given = read(reader, content)
        if len(self._embeddings) >= _MOST_EMBEDDINGS:
            del self._embeddings[next(iter(self._embeddings))]
            self.counts.refuse(topic, _UNCLAIMED)
        if given.stamp_ns in self._embeddings:
            raise BadMessage("there were others of its stamp before")
        self._embeddings[given.stamp_ns] = given

    def count_unclaimed(self) -> None:
        """Count the embeddings whose detections never came."""
        for _ in self._embeddings:
            self.counts.refuse(self.stream.embeddings or "", _UNCLAIMED)
        self._embeddings.clear()


def _encode(document: dict[str, Any]) -> bytes:
    """JSON, with NaN and infinity as Python writes them; the log's validation rejects and names
    them."""
    try:
        payload = msgspec.json.encode(document)
    except (UnicodeError, ValueError):  # a lone surrogate
        payload = b"null"
    if b"null" not in payload:  # what msgspec makes of NaN and infinity
        return payload
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    return text.encode(errors="backslashreplace")


def _dimension(text: str) -> int:
    """How many float32 a base64 text holds, rounded down."""
    return max(len(text.rstrip("=")) * 3 // 16, 1)
