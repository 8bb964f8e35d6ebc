"""Places as Nav2 waypoints, in the file that the Nav2 panel of RViz saves and loads.

Each waypoint has ``pose`` [x, y, z] in metres and ``orientation`` [w, x, y, z], as
``nav2_rviz_plugins`` reads them; it takes them in the order of the file and ignores other keys.
"""

import math
from typing import Any, Final

import yaml

from projections.map.records import PlaceRecord
from projections.map.view import MapView

NEAR_M: Final = 0.5
"""Most metres from a centroid to the nearest pose of its Place; farther ones may lie in a wall or
in furniture."""


def nav2_waypoints(view: MapView) -> str:
    """A waypoint for each Place, in the order in which the Places were founded.

    It is the centroid, facing as the robot did at the keyframe of the Place that is nearest to it.
    Where the robot never was within 0.5 m of the centroid, it is that keyframe's pose.
    """
    waypoints = {
        place.place_id: _waypoint(view, place)
        | ({} if place.name is None else {"name": place.name})
        for place in view.places.values()
    }
    text: str = yaml.safe_dump({"waypoints": waypoints}, sort_keys=False)
    return text


def _waypoint(view: MapView, place: PlaceRecord) -> dict[str, Any]:
    x, y = place.centroid_x, place.centroid_y
    poses = [pose for k in place.members if (pose := view.keyframes[k].pose) is not None]
    nearest = min(poses, key=lambda pose: math.hypot(pose.x_m - x, pose.y_m - y))
    if math.hypot(nearest.x_m - x, nearest.y_m - y) > NEAR_M:
        x, y = nearest.x_m, nearest.y_m
    half = nearest.yaw_rad / 2
    return {
        "pose": [x, y, 0.0],
        "orientation": [round(math.cos(half), 9), 0.0, 0.0, round(math.sin(half), 9)],
    }
