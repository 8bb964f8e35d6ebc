"""The robot's poses by time, from a file or as they arrive, and the pose at which a picture was
taken.

A picture has a pose if one is known within `NEAR_S` of its stamp. With such a pose on each side it
is interpolated linearly; otherwise it is the nearest one.
"""

import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections import deque
from pathlib import Path
from typing import Final, Protocol

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.trajectory import read_trajectory

from .gate import Pose
from .messages import MessageError, pose_of

NEAR_S: Final = 0.1
_KEPT: Final = 20_000
"""Bound of the received poses kept: 100 s of 200 a second."""
_KEPT_BYTES: Final = 16 * 1024 * 1024
"""Bound of the bytes of unread messages: 20,000 of Odometry with covariances take 14 MB."""
_SLACK_S: Final = 1e-6
"""Tolerance for rounding: stamps 100 ms apart are still within 100 ms."""


class Poses(Protocol):
    """The robot's poses by time."""

    def at(self, stamp_s: float) -> Pose | None:
        """The pose at a stamp; None if none is known near it."""


class NoPoses:
    """No poses."""

    def at(self, stamp_s: float) -> Pose | None:  # noqa: ARG002  as `Poses` has it
        """None."""
        return None


class PoseTrack:
    """Poses in order of their stamps."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[Pose] = []

    def add(self, stamp_s: float, pose: Pose) -> None:
        """Add a pose; of equal stamps the last one counts."""
        index = bisect_right(self._stamps, stamp_s)
        if index and self._stamps[index - 1] == stamp_s:
            self._poses[index - 1] = pose
            return
        self._stamps.insert(index, stamp_s)
        self._poses.insert(index, pose)

    def forget_before(self, kept: int) -> None:
        """Keep only so many of the latest poses."""
        del self._stamps[:-kept], self._poses[:-kept]

    def __len__(self) -> int:
        return len(self._stamps)

    def has_soon_after(self, stamp_s: float) -> bool:
        """Whether there is a pose of this stamp or up to `NEAR_S` later."""
        after = bisect_left(self._stamps, stamp_s)
        return after < len(self._stamps) and self._stamps[after] <= stamp_s + NEAR_S + _SLACK_S

    def at(self, stamp_s: float) -> Pose | None:
        """The pose at a stamp, interpolated or the nearest; None if none is within `NEAR_S`."""
        after = bisect_left(self._stamps, stamp_s)
        near = [
            index
            for index in (after - 1, after)
            if 0 <= index < len(self._stamps)
            and abs(self._stamps[index] - stamp_s) <= NEAR_S + _SLACK_S
        ]
        if len(near) == 2:
            return self._between(near[0], near[1], stamp_s)
        return self._poses[near[0]] if near else None

    def _between(self, before: int, after: int, stamp_s: float) -> Pose:
        start, end = self._poses[before], self._poses[after]
        part = (stamp_s - self._stamps[before]) / (self._stamps[after] - self._stamps[before])
        turned = math.remainder(end.yaw - start.yaw, math.tau)
        return Pose(
            start.x + part * (end.x - start.x),
            start.y + part * (end.y - start.y),
            math.remainder(start.yaw + part * turned, math.tau),
        )


def poses_of_file(path: Path) -> PoseTrack:
    """The poses of a trajectory file. Raises MisuseError."""
    trajectory = read_trajectory(path)
    if trajectory.by != "stamp":
        raise MisuseError(
            f"--poses {path}: its poses are by keyframe_id; pictures need poses by stamp"
        )
    track = PoseTrack()
    for pose in trajectory.poses:
        track.add(pose.key, Pose(pose.x, pose.y, pose.yaw))
    return track


class LivePoses:
    """Poses as they arrive: Zenoh's thread queues messages, another thread reads and decodes them.

    Of unread messages only the newest are kept, at most `_KEPT` of them and `_KEPT_BYTES`.
    """

    def __init__(self) -> None:
        self._track = PoseTrack()
        self._last_two_s = (-math.inf, -math.inf)
        """The stamps of the last two poses received."""
        self._messages: deque[tuple[bytes, float]] = deque()
        self._bytes = 0
        self._came = threading.Condition()
        self.count = 0
        """Number of poses read."""
        self.dropped = 0
        """Number of unread messages dropped for newer ones."""
        self.bad = 0
        """Number of messages that are no pose or too large."""
        self.bad_reason: str | None = None
        """The reason for the last of them."""

    def put(self, payload: bytes, received_s: float) -> None:
        """Queue a message; it is decoded when a pose is asked for."""
        with self._came:
            self._messages.append((payload, received_s))
            self._bytes += len(payload)
            while len(self._messages) > _KEPT or self._bytes > _KEPT_BYTES:
                self._bytes -= len(self._messages.popleft()[0])
                self.dropped += 1
            self._came.notify()

    def refuse(self, reason: str) -> None:
        """Count a message that is no pose, or is too large to be read."""
        with self._came:
            self.bad += 1
            self.bad_reason = reason

    def at(self, stamp_s: float) -> Pose | None:
        """The pose at a stamp; waits up to `NEAR_S` for poses of that time to come in."""
        deadline = time.monotonic() + NEAR_S
        while True:
            with self._came:
                left = deadline - time.monotonic()
                if not self._messages and not self._reaches(stamp_s) and left > 0:
                    self._came.wait(left)
                messages = list(self._messages)
                self._messages.clear()
                self._bytes = 0
            for message in messages:
                self._read(*message)
            if self._reaches(stamp_s) or time.monotonic() >= deadline:
                return self._track.at(stamp_s)

    def _reaches(self, stamp_s: float) -> bool:
        """Whether the poses of that time have been received: one is soon after it, or the last two
        are both later. A single pose far in the future, from a wrong clock, does not count."""
        return self._track.has_soon_after(stamp_s) or min(self._last_two_s) >= stamp_s

    def _read(self, payload: bytes, received_s: float) -> None:
        try:
            stamp_s, pose = pose_of(payload, received_s)
        except MessageError as error:
            self.refuse(str(error))
            return
        self.count += 1
        self._last_two_s = (self._last_two_s[1], stamp_s)
        self._track.add(stamp_s, pose)
        if len(self._track) > 2 * _KEPT:
            self._track.forget_before(_KEPT)
