"""A picture of a map: rooms, drive, places, objects, adjacent places.

matplotlib is used through its objects alone: no pyplot, no global state.
"""

from .picture import draw_map, map_png
from .scene import Bridge, Floor, LostRobot, Spot, floor_of

__all__ = ["Bridge", "Floor", "LostRobot", "Spot", "draw_map", "floor_of", "map_png"]
