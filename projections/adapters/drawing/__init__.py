"""A picture of a map: rooms, drive, places, objects, adjacent places.

matplotlib is used through its objects alone: no pyplot, no global state.
"""

from projections.adapters.scene import Floor, LostRobot, MergeMark, Spot, floor_of

from .map_picture import draw_map, map_png

__all__ = ["Floor", "LostRobot", "MergeMark", "Spot", "draw_map", "floor_of", "map_png"]
