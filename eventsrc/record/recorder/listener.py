"""Keyframes of a robot in ROS that is only listened to: nothing is recorded.

They are derived by the same code as those of a log (`bridged`). Zenoh's threads put messages into a
bounded queue; `take` derives in the caller's thread.
"""

import queue
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, NamedTuple, Self

from eventsrc.envelope.ingest import Accepted, ingest
from eventsrc.record.transport.session import Received, Session, Subscription
from eventsrc.ros.library import MessageTypes, Undecodable
from eventsrc.ros.messages import BadMessage, frame_name, read, transform_of
from eventsrc.ros.transforms import TransformBuffer

from .bridged import Bridge
from .checking import CheckedMessage
from .queue import BridgedMessage

_CACHE_TIMEOUT_S: Final = 2.0
_MAX_CACHED: Final = 1_000
"""Limit for the messages fetched from the caches of one topic."""
_MOST_WAITING: Final = 10_000


def subscribe_to(
    session: Session, bridge: Bridge, receive: Callable[[Received], None]
) -> list[Subscription]:
    """Subscribe to the tokens of publishers of a bridge's topics, then to their messages."""
    wire = bridge.wire
    tokens = [each for topic in bridge.topics for each in wire.token_selectors(topic)]
    found = [session.subscribe_tokens(each, bridge.note_token) for each in tokens]
    return found + [
        session.subscribe(key, receive, in_order=True, read_attachment=wire.read_attachment)
        for key in bridge.keys
    ]


def fetch_kept(
    session: Session, bridge: Bridge, topics: Sequence[str], receive: Callable[[Received], None]
) -> None:
    """Get the messages of topics that their publishers keep for late subscribers."""
    wire = bridge.wire
    for selector in (each for topic in topics for each in wire.cache_selectors(topic)):
        for message in session.cached(
            selector,
            timeout_s=_CACHE_TIMEOUT_S,
            most=_MAX_CACHED,
            read_attachment=wire.read_attachment,
        ):
            receive(message)


class Heard(NamedTuple):
    """A keyframe, and where its camera is in the frame of the robot's base, metres ahead and to the
    left."""

    keyframe: Accepted
    camera: tuple[float, float]


class Listener:
    """Listens to the topics of a ``bridge``; a context manager. ``lost`` counts messages for which
    there was no room."""

    def __init__(self, session: Session, bridge: Bridge, types: MessageTypes) -> None:
        self._session, self._bridge, self._types = session, bridge, types
        self._queue: queue.Queue[Received] = queue.Queue(_MOST_WAITING)
        streams = bridge.recording.streams
        self._buffer = TransformBuffer(streams[0].max_gap_ns)
        self._bases = {each.detections: each.base_frame for each in streams}
        self._static = {each.tf_static for each in streams}
        self._moving = {each.tf for each in streams}
        self._camera = 0.0, 0.0
        self.lost = 0
        self._subscriptions = subscribe_to(session, bridge, self._receive)
        session.confirm()
        bridge.take_new_latched()
        fetch_kept(session, bridge, bridge.latched_topics, self._receive)

    def take(self, timeout_s: float) -> list[Heard]:
        """The keyframes that the messages received by now complete; waits for the first message."""
        batch: list[BridgedMessage] = []
        try:
            first: Received | None = self._queue.get(timeout=timeout_s)
            while first is not None:
                self._note_transforms(first)
                batch.append(BridgedMessage(first.key, first.payload, first.number))
                first = self._queue.get_nowait()
        except queue.Empty:
            pass
        fetch_kept(self._session, self._bridge, self._bridge.take_new_latched(), self._receive)
        found: list[Heard] = []

        def keep(messages: Sequence[Received]) -> Iterator[CheckedMessage]:
            for message in messages:
                made = ingest(message.payload)
                if isinstance(made, Accepted):
                    found.append(Heard(made, self._camera))
            return iter(())

        self._bridge.take(batch, time.time_ns(), keep)
        return found

    def close(self) -> None:
        """Stop listening."""
        for each in self._subscriptions:
            each.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _receive(self, message: Received) -> None:
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self.lost += 1

    def _note_transforms(self, message: Received) -> None:
        """Note transforms, and by those the camera of detections. A message that cannot be read is
        left to the bridge, which counts it."""
        parts = self._bridge.wire.read_key(message.key)
        if parts is None or parts.type_name is None:
            return
        try:
            if parts.topic in self._static | self._moving:
                content = self._types.decode(message.payload, parts.type_name)
                for each in content.transforms:
                    self._note_transform(each, is_static=parts.topic in self._static)
            elif parts.topic in self._bases:
                header = self._types.decode(message.payload, parts.type_name).header
                stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
                at = self._buffer.lookup(
                    self._bases[parts.topic], frame_name(header.frame_id), stamp_ns
                )
                if at is not None:
                    self._camera = at.x, at.y
        except (BadMessage, Undecodable, AttributeError):
            return

    def _note_transform(self, given: Any, *, is_static: bool) -> None:
        try:
            each = read(transform_of, given)
        except BadMessage:  # the others of its message are used, as by the bridge
            return
        if is_static:
            self._buffer.add_static(each.parent, each.child, each.pose)
        else:
            self._buffer.add(each.parent, each.child, each.stamp_ns, each.pose)
