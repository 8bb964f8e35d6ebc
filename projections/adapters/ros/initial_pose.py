"""Where a lost robot is, published on ``/initialpose`` once that is sure.

Asked by the service ``~/localize``, it listens to the robot's detections, as `record --ros2` does,
with the robot's movement from odometry, and asks the map after each keyframe. In a thread of its
own: finding topics waits for publishers, and questions take a while.
"""

import math
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Final

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import counted
from eventsrc.record.recorder.listener import Heard, Listener
from eventsrc.record.ros_node import RosNode
from projections.fold.map_errors import DatabaseError, QuestionError
from projections.localize.relocalize import Answer, Question
from projections.localize.relocalize.waking_robot import SurePose, WakingRobot

from .map_messages import POSE_WITH_COVARIANCE, MapMessages

TOPIC: Final = "/initialpose"
_WAIT_S: Final = 0.25
_MOST_KEYFRAMES: Final = 200
"""After so many it gives up."""

Listen = Callable[[], AbstractContextManager[Listener] | None]
"""Finds the robot's topics and listens to them; None if it was stopped before."""
Ask = Callable[[Question], Answer]


class InitialPose:
    """Publishes initial poses. ``listen`` and ``ask`` are called in the thread of `run`, ``note``
    with lines for people."""

    def __init__(
        self, node: RosNode, listen: Listen, ask: Ask, note: Callable[[str], None]
    ) -> None:
        self._listen, self._ask, self._note = listen, ask, note
        self._messages = MapMessages(node.types)
        self._publisher = node.publisher(TOPIC, POSE_WITH_COVARIANCE)
        self._wanted = threading.Event()
        self._fault: str | None = None  # why the last question was not answered
        node.trigger("~/localize", self.start)

    def start(self) -> tuple[bool, str]:
        """Begin to look, from any thread; says so as the answer of the service."""
        if self._wanted.is_set():
            return True, f"looking already; {self._publisher.topic} follows once it is sure"
        self._wanted.set()
        return True, f"looking; turn the robot; {self._publisher.topic} follows once it is sure"

    def run(self, stop: threading.Event) -> None:
        """Look whenever it is asked, until ``stop``."""
        while not stop.is_set():
            if not self._wanted.wait(_WAIT_S):
                continue
            try:
                self._look(stop)
            except MapfoldError as error:
                self._note(f"the robot cannot be found: {error}")
            finally:
                self._wanted.clear()

    def _look(self, stop: threading.Event) -> None:
        found = self._listen()
        if found is None:
            return
        with found as listener:
            self._look_by(listener, stop)
            if listener.lost:
                lost = counted(listener.lost, "message")
                self._note(f"left out {lost}, which came faster than they could be read")

    def _look_by(self, listener: Listener, stop: threading.Event) -> None:
        robot, seen = WakingRobot(), 0
        self._fault = None
        while not stop.is_set() and seen < _MOST_KEYFRAMES:
            for heard in listener.take(_WAIT_S):
                if stop.is_set() or seen == _MOST_KEYFRAMES:
                    break
                seen += 1
                sure = self._judge(robot, heard)
                if sure is not None:
                    self._publish(sure, heard)
                    self._note(_text(sure, seen))
                    return
        if seen:
            self._note(f"after {seen} keyframes it is not sure where the robot is; gave up")

    def _judge(self, robot: WakingRobot, heard: Heard) -> SurePose | None:
        question = robot.see(heard.keyframe)
        if question is None:
            return None
        try:
            answer = self._ask(question)
        except (QuestionError, DatabaseError) as error:
            if self._fault != str(error):
                self._fault = str(error)
                self._note(f"a question could not be answered: {error}")
            return None
        self._fault = None
        return robot.judge(answer)

    def _publish(self, sure: SurePose, heard: Heard) -> None:
        """Publish the pose of the base, whose camera is where the answer says, with the time of the
        keyframe: localisers move it on by what odometry says since."""
        camera, stamp_ns = heard.camera, heard.keyframe.envelope.stamp_ns
        cos, sin = math.cos(sure.yaw), math.sin(sure.yaw)
        x = sure.x - (cos * camera[0] - sin * camera[1])
        y = sure.y - (sin * camera[0] + cos * camera[1])
        self._publisher.publish(
            self._messages.pose_with_covariance(x, y, sure.yaw, sure.covariance, stamp_ns)
        )


def _text(sure: SurePose, keyframes: int) -> str:
    sigma_m = math.sqrt(max(sure.covariance[0], sure.covariance[4]))
    floor = "" if sure.floor is None else f" on floor {sure.floor}"
    facing = f"facing {math.degrees(sure.yaw):.0f}°"
    return (
        f"{TOPIC}: ({sure.x:.2f}, {sure.y:.2f}){floor} ± {sigma_m:.2f} m, {facing}, after"
        f" {keyframes} keyframes"
    )
