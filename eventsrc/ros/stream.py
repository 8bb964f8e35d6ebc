"""Streams: a topic of detections with its run, and the poses at which its pictures were taken.

The pose is interpolated at the picture's stamp, from transforms, odometry or a localiser's poses.
``x``, ``y`` are the camera's position, since bearings start there; ``yaw`` is the heading of the
robot's base, ``camera_yaw`` the angle from it to the camera's heading. Results are rounded to
micrometres and nanoradians.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, TypeAlias

from . import messages
from .transforms import TimeSeries, Transform, TransformBuffer, compose, interpolate, rotate

DEFAULT_WAIT_NS: Final = 1_000_000_000
DEFAULT_MAX_GAP_NS: Final = 500_000_000
MAX_WAITING: Final = 1_000


@dataclass(frozen=True)
class Stream:
    """A topic of detections, and the topics that complete its envelopes.

    ``pose`` is the topic of an Odometry or PoseWithCovarianceStamped, whose frame is then the
    map's; None for the transforms from ``map_frame`` down to ``base_frame`` and the camera.
    ``covariance`` is the topic whose latest covariance, of a pose in ``map_frame``, goes with poses
    of transforms. ``embeddings`` and ``camera`` are topics, None without any. ``classes`` are the
    topics of `eventsrc.ros.named_classes`; ``labels`` names classes by id itself, and counts before
    what they say. ``heights`` says whether ``map_z`` is stated. ``wait_ns`` and ``max_waiting``
    bound how long detections wait for the rest, ``max_gap_ns`` between which two samples a pose is
    interpolated. ``images`` is the topic of the pictures that crops are cut from,
    ``scan`` that of the range scans that go with keyframes.
    """

    detections: str
    run_id: str
    tf: str | None = "/tf"
    tf_static: str | None = "/tf_static"
    pose: str | None = None
    covariance: str | None = None
    embeddings: str | None = None
    camera: str | None = None
    map_frame: str = "map"
    base_frame: str = "base_link"
    labels: Mapping[str, str] = field(default_factory=dict)
    embedding_model: str | None = None
    heights: bool = False
    first_keyframe: int = 0
    wait_ns: int = DEFAULT_WAIT_NS
    max_gap_ns: int = DEFAULT_MAX_GAP_NS
    max_waiting: int = MAX_WAITING
    classes: tuple[str, ...] = ()
    images: str | None = None
    scan: str | None = None

    @property
    def has_poses(self) -> bool:
        """Whether there is a topic that poses may come from."""
        return any((self.pose, self.tf, self.tf_static))


@dataclass
class Counts:
    """Counts of a stream's keyframes and detections, by what they have or lack."""

    keyframes: int = 0
    detections: int = 0
    without_pose: int = 0
    without_camera_frame: int = 0
    """Keyframes with the base's pose, since no transform led to the camera."""
    without_base_frame: int = 0
    """Keyframes with the camera's heading for that of the base, to which no transform led."""
    without_camera: int = 0
    """Keyframes without field of view and picture size."""
    without_covariance: int = 0
    """Keyframes that have a pose without a covariance."""
    with_embedding: int = 0
    """Detections that have an embedding."""
    with_position: int = 0
    """Detections that have a measured position."""
    unclassified: int = 0
    """Detections without a hypothesis."""
    numbered: int = 0
    """Detections whose class is a number, which nothing names."""
    with_scan: int = 0
    """Keyframes that have a range scan."""
    crops: int = 0
    """Detections of which a crop is kept."""
    without_picture: int = 0
    """Keyframes with detections, but without their picture, where crops are kept."""
    outside: int = 0
    """Detections whose box has no pixel of the picture."""
    unused: dict[str, int] = field(default_factory=dict)
    """Number of messages, or transforms in them, that could not be used, by topic."""
    reasons: dict[str, str] = field(default_factory=dict)
    """The reason for the first of them, by topic."""

    def refuse(self, topic: str, reason: str) -> None:
        """Count a message that cannot be used."""
        self.unused[topic] = self.unused.get(topic, 0) + 1
        self.reasons.setdefault(topic, reason)


_MOST_POSES: Final = 50_000
_UPRIGHT: Final = 0.5
"""Least vertical component, at 30° from the horizontal, of a z axis that is no optical axis."""
_METRES, _RADIANS = 6, 9
_Found: TypeAlias = tuple[Transform | None, Transform | None, messages.Covariance | None]
"""The base, the camera and the error of the pose."""


@dataclass(frozen=True, slots=True)
class PicturePose:
    """A pose in the map frame, metres and radians; ``z`` is the base's height. ``has_base`` says
    whether the base's frame was known; ``camera`` is the whole pose of the camera's, if it was."""

    x: float
    y: float
    z: float
    yaw: float
    camera_yaw: float
    covariance: messages.Covariance | None
    has_base: bool
    camera: Transform | None


class PoseSource:
    """The poses of one stream."""

    def __init__(self, stream: Stream, buffer: TransformBuffer, counts: Counts) -> None:
        self._stream = stream
        self._buffer = buffer
        self._counts = counts
        self._given: TimeSeries[messages.StampedPose] = TimeSeries()
        self._frame: str | None = None
        self.received = 0
        """Number of messages added, without those that other streams added to a shared buffer."""

    def add_transforms(self, topic: str, type_name: str, message: Any) -> None:
        """Add the transforms of a TFMessage; they are static if ``topic`` is the stream's
        ``tf_static``."""
        self.received += 1
        _expect(type_name, messages.TF)
        static = topic == self._stream.tf_static
        for each in messages.read(lambda m: [*m.transforms], message):
            try:
                parent, child, stamp_ns, pose = messages.read(messages.transform_of, each)
            except messages.BadMessage as error:
                self._counts.refuse(topic, str(error))
                continue
            if static:
                self._buffer.add_static(parent, child, pose)
            else:
                self._buffer.add(parent, child, stamp_ns, pose)

    def add_pose(self, topic: str, type_name: str, message: Any) -> None:
        """Add a pose of odometry or of a localiser. Raises BadMessage."""
        self.received += 1
        _expect(type_name, messages.ODOMETRY, messages.POSE)
        pose = messages.read(messages.pose_of, message)
        if pose.fault is not None:
            self._counts.refuse(topic, pose.fault)
        frame = self.frame
        if frame is None:
            frame = self._frame = pose.parent
        if pose.parent != frame:
            raise messages.BadMessage(
                f"it is in the frame {pose.parent!r:.80}, not in {frame!r:.80}"
            )
        self._given.add(pose.stamp_ns, pose)
        if len(self._given.stamps) > _MOST_POSES:
            self._given.forget_half()

    @property
    def frame(self) -> str | None:
        """The frame that the poses are in; None before it is known."""
        return self._stream.map_frame if self._stream.pose is None else self._frame

    def at(self, stamp_ns: int, camera: str, *, final: bool) -> PicturePose | None:
        """The pose of a picture; None while it is unknown. ``camera`` is the frame of the camera.

        With ``final`` the base's pose stands for an unknown camera's, and the other way round.
        """
        of = self._of_transforms if self._stream.pose is None else self._of_poses
        base, there, covariance = of(stamp_ns, camera, final=final)
        if base is None or there is None:
            if not final or (at := base or there) is None:
                return None
        else:
            at = there
        looks = None if there is None else heading_of_camera(there, camera)
        yaw = heading(base) if base is not None else looks or 0.0
        return PicturePose(
            round(at.x, _METRES),
            round(at.y, _METRES),
            round((base or at).z, _METRES),
            round(yaw, _RADIANS),
            0.0 if looks is None else round(math.remainder(looks - yaw, math.tau), _RADIANS),
            covariance,
            base is not None,
            there,
        )

    def _of_transforms(self, stamp_ns: int, camera: str, *, final: bool) -> _Found:
        stream, lookup = self._stream, self._buffer.lookup
        base = lookup(stream.map_frame, stream.base_frame, stamp_ns)
        there = base
        if base is None:
            if not final:
                return None, None, None
            there = lookup(stream.map_frame, camera, stamp_ns) if camera else None
        elif camera:
            inside = lookup(stream.base_frame, camera, stamp_ns)
            there = None if inside is None else compose(base, inside)
        known = self._given.latest(stamp_ns)
        return base, there, None if known is None else known.covariance

    def _of_poses(self, stamp_ns: int, camera: str, *, final: bool) -> _Found:  # noqa: ARG002
        around = self._given.around(stamp_ns, self._stream.max_gap_ns)
        if around is None:
            return None, None, None
        before, after, share = around
        base = interpolate(before.pose, after.pose, share)
        covariance = _between(before.covariance, after.covariance, share)
        child = before.child or self._stream.base_frame
        inside = self._buffer.lookup(child, camera or child, stamp_ns)
        return base, None if inside is None else compose(base, inside), covariance


def heading(t: Transform) -> float:
    """The direction of the x axis on the ground, radians."""
    x, y, _ = rotate(t, 1.0, 0.0, 0.0)
    return math.atan2(y, x)


def is_optical(t: Transform | None, frame: str) -> bool:
    """Whether a camera looks along the z axis of its frame, see `heading_of_camera`."""
    return "optical" in frame or (t is not None and abs(rotate(t, 0.0, 0.0, 1.0)[2]) < _UPRIGHT)


def heading_of_camera(t: Transform, frame: str) -> float:
    """The heading of a camera on the ground, radians: along z in an optical frame, along x in a
    frame of the robot's body. A frame without ``optical`` in its name counts as optical if its z
    axis is within 30° of the horizontal."""
    if not is_optical(t, frame):
        return heading(t)
    x, y, _ = rotate(t, 0.0, 0.0, 1.0)
    return math.atan2(y, x)


def _between(
    a: messages.Covariance | None, b: messages.Covariance | None, share: float
) -> messages.Covariance | None:
    if a is None or b is None:
        return None
    return tuple((1.0 - share) * one + share * other for one, other in zip(a, b, strict=True))


def _expect(type_name: str, *expected: str) -> None:
    if type_name not in expected:
        raise messages.BadMessage(f"it is {type_name:.80}, not {' or '.join(expected)}")
