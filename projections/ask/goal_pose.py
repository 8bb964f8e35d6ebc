"""The goal of a robot: a pose from which to see a thing, as JSON and for ROS 2."""

import math
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class GoalPose:
    """A pose in metres and radians from which to see a thing, ``distance_m`` away. ``ground`` says
    what it stands on: ``seen`` that the thing was seen from there, by ``run_id`` and
    ``keyframe_id``. ``walls_known`` is false where no occupancy map says how far walls are."""

    x: float
    y: float
    yaw: float
    distance_m: float
    ground: str
    walls_known: bool
    floor: str | None
    run_id: str | None
    keyframe_id: int | None
    frame_id: str = "map"

    def __repr__(self) -> str:
        at = f"({self.x:.2f}, {self.y:.2f}) facing {math.degrees(self.yaw):.0f}°"
        return f"<goal at {at}, {self.distance_m:.2f} m away, {self.ground} ground>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    def pose_stamped(self) -> str:
        """As ``geometry_msgs/PoseStamped`` in YAML, its stamp zero, which means now."""
        position, orientation = self._in_yaml()
        return (
            "header:\n  stamp: {sec: 0, nanosec: 0}\n  frame_id: map\n"
            f"pose:\n  position: {position}\n  orientation: {orientation}\n"
        )

    def topic_pub(self) -> str:
        """As a command line of ROS 2 that sends it to Nav2."""
        position, orientation = self._in_yaml()
        pose = f"{{position: {position}, orientation: {orientation}}}"
        message = f"{{header: {{frame_id: map}}, pose: {pose}}}"
        return f"ros2 topic pub --once /goal_pose geometry_msgs/msg/PoseStamped '{message}'\n"

    def _in_yaml(self) -> tuple[str, str]:
        z, w = math.sin(self.yaw / 2), math.cos(self.yaw / 2)
        return (
            f"{{x: {self.x:.3f}, y: {self.y:.3f}, z: 0.0}}",
            f"{{x: 0.0, y: 0.0, z: {z:.6f}, w: {w:.6f}}}",
        )
