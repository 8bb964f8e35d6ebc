"""The robot's poses by time, from a file or as they arrive, and the pose at which a picture was
taken.

A message that arrives is JSON with ``x``, ``y``, ``yaw`` (or ``map_x`` …) and ``stamp`` or
``timestamp``, or in CDR geometry_msgs/PoseStamped, PoseWithCovarianceStamped or nav_msgs/Odometry.
The type of a message follows from its length.

A picture has a pose if one is known within `NEAR_S` of its stamp. With such a pose on each side it
is interpolated linearly; otherwise it is the nearest one.
"""

import json
import math
import threading
import time
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from eventsrc.base.errors import MisuseError
from eventsrc.envelope.cdr import CdrFault, CdrFields, is_cdr
from eventsrc.envelope.model import MAX_POSITION_M, MAX_TIMESTAMP_S
from eventsrc.envelope.trajectory import read_trajectory

NEAR_S: Final = 0.1
_KEPT: Final = 20_000
"""Bound of the received poses kept: 100 s of 200 a second."""
_KEPT_BYTES: Final = 16 * 1024 * 1024
"""Bound of the bytes of unread messages: 20,000 of Odometry with covariances take 14 MB."""
_SLACK_S: Final = 1e-6
"""Tolerance for rounding: stamps 100 ms apart are still within 100 ms."""
_POSE_BYTES: Final = 56
_COVARIANCE_BYTES: Final = 288
_TWIST_BYTES: Final = 48 + _COVARIANCE_BYTES
_MOST_PADDING: Final = 3
_NORM_SLACK: Final = 0.1


class RobotPose(NamedTuple):
    """The robot's pose in the map frame: metres, and radians to the left of the x axis."""

    x: float
    y: float
    yaw: float


class PoseTrack:
    """The robot's poses in order of their stamps."""

    def __init__(self) -> None:
        self._stamps: list[float] = []
        self._poses: list[RobotPose] = []

    def add(self, stamp_s: float, pose: RobotPose) -> None:
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

    def at(self, stamp_s: float) -> RobotPose | None:
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

    def _between(self, before: int, after: int, stamp_s: float) -> RobotPose:
        start, end = self._poses[before], self._poses[after]
        part = (stamp_s - self._stamps[before]) / (self._stamps[after] - self._stamps[before])
        turned = math.remainder(end.yaw - start.yaw, math.tau)
        return RobotPose(
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
        track.add(pose.key, RobotPose(pose.x, pose.y, pose.yaw))
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

    def at(self, stamp_s: float) -> RobotPose | None:
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


Poses = PoseTrack | LivePoses


class MessageError(ValueError):
    """A message that is no picture or no pose; the text is the reason."""


def pose_of(payload: bytes, received_s: float) -> tuple[float, RobotPose]:
    """Stamp, in seconds, and pose of a message. Raises MessageError."""
    if is_cdr(payload):
        try:
            return _pose_of_cdr(CdrFields(payload), received_s)
        except CdrFault as fault:
            raise MessageError(f"no pose in CDR: {fault}") from None
    return _pose_of_json(payload, received_s)


def _pose_of_cdr(fields: CdrFields, received_s: float) -> tuple[float, RobotPose]:
    stamp_s = header_stamp(fields, received_s)
    if not _is_length(fields.left(8), _POSE_BYTES, _POSE_BYTES + _COVARIANCE_BYTES):
        fields.text("child_frame_id")
        if not _is_length(fields.left(8), _POSE_BYTES + _COVARIANCE_BYTES + _TWIST_BYTES):
            raise MessageError(
                "a message in CDR of another length than geometry_msgs/PoseStamped, "
                "PoseWithCovarianceStamped and nav_msgs/Odometry have"
            )
    x, y, _ = fields.numbers("ddd", "position")
    return stamp_s, _checked(x, y, _yaw(fields.numbers("dddd", "orientation")))


def _is_length(left: int, *lengths: int) -> bool:
    """Whether ``left`` bytes are one of ``lengths``, or that plus padding."""
    return any(length <= left <= length + _MOST_PADDING for length in lengths)


def header_stamp(fields: CdrFields, received_s: float) -> float:
    """The stamp of a header in seconds, ``received_s`` if it is zero. Skips the frame."""
    seconds, nanoseconds = fields.numbers("iI", "header.stamp")
    fields.text("header.frame_id")
    if seconds < 0 or nanoseconds >= 1_000_000_000:
        raise CdrFault(f"header.stamp is {seconds} s and {nanoseconds} ns")
    return received_s if seconds == nanoseconds == 0 else seconds + nanoseconds / 1e9


def _yaw(quaternion: tuple[float, ...]) -> float:
    norm = math.sqrt(math.fsum(q * q for q in quaternion))
    if not abs(norm - 1.0) <= _NORM_SLACK:
        raise MessageError(f"a pose whose quaternion has length {norm:.3g} instead of 1")
    x, y, z, w = (q / norm for q in quaternion)
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _pose_of_json(payload: bytes, received_s: float) -> tuple[float, RobotPose]:
    try:
        document = json.loads(payload)
    except (ValueError, RecursionError):
        raise MessageError("a pose that is neither JSON nor CDR") from None
    if not isinstance(document, dict):
        raise MessageError("a pose that is no JSON object")
    numbers = [_first(document, names) for names in (("x", "map_x"), ("y", "map_y"))]
    yaw = _first(document, ("yaw", "map_yaw"))
    stamp = _first(document, ("stamp", "timestamp"))
    if None in numbers or yaw is None:
        raise MessageError("a pose without the numbers x, y and yaw")
    stamp_s = received_s if stamp is None else stamp
    if not 0.0 <= stamp_s <= MAX_TIMESTAMP_S:
        raise MessageError(f"a pose with the stamp {stamp_s:g}, which is no Unix time")
    return stamp_s, _checked(float(numbers[0] or 0.0), float(numbers[1] or 0.0), yaw)


def _first(document: Mapping[str, Any], names: tuple[str, ...]) -> float | None:
    for name in names:
        value = document.get(name)
        if isinstance(value, int | float) and not isinstance(value, bool):
            return _float(value)
    return None


def _float(value: float) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _checked(x: float, y: float, yaw: float) -> RobotPose:
    if not (abs(x) <= MAX_POSITION_M and abs(y) <= MAX_POSITION_M and math.isfinite(yaw)):
        raise MessageError(f"a pose at x {x:g}, y {y:g}, yaw {yaw:g}")
    return RobotPose(x, y, yaw)
