"""Pictures and poses received over Zenoh.

Zenoh's thread only puts messages into queues. The queue of pictures is short and drops the oldest:
a detector that is slower than the camera processes current pictures, and counts those it missed.
"""

import threading
from collections import deque
from collections.abc import Iterator
from typing import Final

from eventsrc.base.clock import Clock, system_clock
from eventsrc.record.transport.session import Received, SequenceNumber, Session, SizeLimit

from .messages import MessageError, picture_of
from .picture import MAX_PICTURE_BYTES, Picture, PictureError, Pixels
from .poses import LivePoses

QUEUE: Final = 4
_MAX_POSE_BYTES: Final = 64 * 1024
_POLL_S: Final = 0.25


class NewestQueue:
    """A queue of at most ``size`` pictures; one more replaces the oldest. Thread-safe."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._waiting: deque[tuple[Received, float]] = deque()
        self._filled = threading.Condition()
        self.dropped = 0
        """Number of pictures dropped for newer ones, or when the queue was closed."""
        self.too_large = 0
        """Number of pictures refused because they are too large."""

    def put(self, message: Received, received_s: float) -> None:
        """Add a picture."""
        with self._filled:
            if len(self._waiting) == self._size:
                self._waiting.popleft()
                self.dropped += 1
            self._waiting.append((message, received_s))
            self._filled.notify()

    def close(self) -> None:
        """Drop the pictures in the queue."""
        with self._filled:
            self.dropped += len(self._waiting)
            self._waiting.clear()

    def get(self, timeout_s: float) -> tuple[Received, float] | None:
        """Remove and return the oldest picture with its time of receipt; None after ``timeout_s``
        without one."""
        with self._filled:
            if not self._waiting:
                self._filled.wait(timeout_s)
            return self._waiting.popleft() if self._waiting else None


class LivePictures:
    """Pictures under ``image_key`` and poses under ``pose_key``; iterating ends with ``stop``."""

    def __init__(
        self,
        session: Session,
        image_key: str | None,
        pose_key: str | None,
        stop: threading.Event,
        *,
        queue: int = QUEUE,
        clock: Clock = system_clock,
    ) -> None:
        self._stop, self._clock = stop, clock
        self.queue = NewestQueue(queue)
        self.poses = LivePoses() if pose_key is not None else None
        if self.poses is not None and pose_key is not None:
            limit = SizeLimit(_MAX_POSE_BYTES, self._refuse_pose)
            session.subscribe(pose_key, self._on_pose, limit)
        if image_key is not None:
            limit = SizeLimit(MAX_PICTURE_BYTES, self._refuse_picture)
            session.subscribe(image_key, self._on_picture, limit)
        session.confirm()

    def __iter__(self) -> Iterator[Picture]:
        number = 0
        while not self._stop.is_set():
            found = self.queue.get(_POLL_S)
            if found is None:
                continue
            message, received_s = found
            name = f"{message.key}, picture {number}"
            number += 1
            try:
                yield picture_of(message.payload, name, received_s)
            except MessageError as error:
                yield Picture(name, received_s, _Failing(str(error)))
        self.queue.close()

    def _now_s(self) -> float:
        return self._clock() / 1e9

    def _on_picture(self, message: Received) -> None:
        self.queue.put(message, self._now_s())

    def _on_pose(self, message: Received) -> None:
        if self.poses is not None:
            self.poses.put(message.payload, self._now_s())

    def _refuse_pose(self, _key: str, _number: SequenceNumber | None) -> None:
        if self.poses is not None:
            self.poses.refuse(f"a message of more than {_MAX_POSE_BYTES:,} bytes")

    def _refuse_picture(self, _key: str, _number: SequenceNumber | None) -> None:
        self.queue.too_large += 1


class _Failing:
    """The ``pixels`` function of a picture that cannot be read; raises PictureError."""

    def __init__(self, reason: str) -> None:
        self._reason = reason

    def __call__(self) -> Pixels:
        raise PictureError(self._reason)
