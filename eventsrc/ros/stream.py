"""Streams: a topic of detections with its run, and the topics and frames of its poses."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

DEFAULT_WAIT_NS: Final = 1_000_000_000
DEFAULT_MAX_GAP_NS: Final = 500_000_000
MAX_WAITING: Final = 1_000


@dataclass(frozen=True)
class Stream:
    """A topic of detections, and the topics that complete its envelopes.

    ``pose`` is the topic of an Odometry or PoseWithCovarianceStamped, whose frame is then the
    map's; None for the transforms from ``map_frame`` down to ``base_frame`` and the camera.
    ``covariance`` is the topic whose latest covariance, of a pose in ``map_frame``, goes with poses
    of transforms. ``embeddings`` and ``camera`` are topics, None without any. ``labels`` names
    classes by id. ``heights`` says whether ``map_z`` is stated. ``wait_ns`` and ``max_waiting``
    bound how long detections wait for the rest, ``max_gap_ns`` between which two samples a pose is
    interpolated.
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
    unclassified: int = 0
    """Detections without a hypothesis."""
    unused: dict[str, int] = field(default_factory=dict)
    """Number of messages, or transforms in them, that could not be used, by topic."""
    reasons: dict[str, str] = field(default_factory=dict)
    """The reason for the first of them, by topic."""

    def refuse(self, topic: str, reason: str) -> None:
        """Count a message that cannot be used."""
        self.unused[topic] = self.unused.get(topic, 0) + 1
        self.reasons.setdefault(topic, reason)
