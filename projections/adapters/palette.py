"""Colours of pictures and scenes: of places, and of what is drawn under and over them."""

import colorsys

INK = "#22262b"
FAINT = "#8b939c"
WALL = "#3b4149"
FLOOR = "#fbfaf7"
FURNITURE = "#e9e5dc"
FURNITURE_EDGE = "#d8d2c4"
ROOM_NAME = "#6a7179"
SMALL_PRINT = "#4b525a"
LEADER = "#9aa1a9"
BRIDGE = "#8a1c7c"
TRUTH = "#0b0d10"
ESTIMATE = "#d3262e"

_BASE = (
    *("#3b82c4", "#e08a1e", "#3a9d5d", "#c2508f", "#7a63c7", "#b3a12a"),
    *("#2aa5a8", "#d9634c", "#7d8f2b", "#a2583b", "#5f7fe0", "#cf78c6"),
)
_GOLDEN = 0.618033988749895


def place_colour(index: int) -> str:
    """The colour of the ``index``-th place as #rrggbb: twelve chosen ones, then hues between."""
    if index < len(_BASE):
        return _BASE[index]
    red, green, blue = colorsys.hls_to_rgb((index * _GOLDEN) % 1.0, 0.45, 0.5)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"
