"""A picture of a map: rooms, drive, places, objects, adjacent places.

matplotlib is used through its objects alone: no pyplot, no global state.
"""

from projections.adapters.scene import HousePlan, LostRobot, MergeMark, Spot, plan_of

from .map_picture import draw_map, map_png

__all__ = ["HousePlan", "LostRobot", "MergeMark", "Spot", "draw_map", "map_png", "plan_of"]
