"""Goals of a robot: how `find` and `path` print them, and how `find --send` sends them."""

import time
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Final

import typer

from eventsrc.base.errors import MapfoldError, MisuseError
from projections.ask.goal_pose import GoalPose

from .options import DomainOption, ZenohClient, domain_of, option
from .terminal import display, emit, say


class GoalForm(StrEnum):
    """How a goal is printed."""

    JSON = "json"
    YAML = "yaml"
    ROS2 = "ros2"


GoalOption = Annotated[
    GoalForm | None,
    option(
        "json|yaml|ros2",
        "Print instead the pose from which a robot sees it: as JSON, a PoseStamped in YAML, or"
        " a ros2 command that sends it.",
        "--goal",
    ),
]
ClearanceOption = Annotated[
    float,
    option("METRES", "Least distance of goals from walls.", "--clearance", min=0.0, max=100.0),
]


def print_goal(found: GoalPose, form: GoalForm) -> None:
    """Print a goal."""
    if form is GoalForm.JSON:
        emit(found.document())
    else:
        display(found.pose_stamped() if form is GoalForm.YAML else found.topic_pub())


_TOPIC: Final = "/goal_pose"
_WAIT_S: Final = 5.0


@dataclass(frozen=True, kw_only=True)
class GoalSender(ZenohClient):
    """``--send`` and what goes with it."""

    send_: Annotated[
        bool,
        typer.Option(
            "--send",
            help=f"Send the goal as a PoseStamped on {_TOPIC}, over rmw_zenoh (extra [ros]).",
        ),
    ] = False
    domain: DomainOption = None
    namespace: Annotated[
        str, option("NS", "Of the robot with --send, as /bot1.", "--namespace")
    ] = ""

    def check(self, goal: GoalForm | None) -> None:
        """Raise MisuseError for options that do not go together."""
        if self.send_ and goal is None:
            raise MisuseError("--send sends a goal; give --goal json|yaml|ros2 too")
        if not self.send_ and (self != GoalSender()):
            raise MisuseError("--domain, --namespace, --connect and --zenoh-config go with --send")

    def send(self, goal: GoalPose) -> None:
        """Send a goal if ``--send`` is given; returns when Zenoh has accepted it."""
        if not self.send_:
            return
        # Imported here: most questions send nothing.
        from eventsrc.record.ros_node import RosNode
        from eventsrc.ros.library import MessageTypes
        from eventsrc.ros.wire import topic_of
        from projections.adapters.ros.map_messages import POSE, MapMessages

        number, types = domain_of(self.domain), MessageTypes()
        under = topic_of(self.namespace, "goal_pose", "--namespace").removesuffix(_TOPIC)
        with self.session() as session, RosNode(session, types, number, under, "mapfold") as node:
            publisher = node.publisher(_TOPIC, POSE)
            if not publisher.wait_for_subscriber(_WAIT_S):
                raise MapfoldError(
                    f"{publisher.topic} has no subscriber in domain {number}; check that Nav2"
                    " runs over rmw_zenoh, and --domain, --namespace and --connect"
                )
            x, y, yaw = goal.x, goal.y, goal.yaw
            publisher.publish(MapMessages(types).pose(x, y, yaw, time.time_ns()))
            session.confirm()
            say(f"sent to {publisher.topic}")
