"""Plane geometry in integer micrometres."""

import math


def distance_um(ax: int, ay: int, bx: int, by: int) -> int:
    """The distance of two points, rounded down to whole micrometres."""
    return math.isqrt((ax - bx) ** 2 + (ay - by) ** 2)


def is_within(ax: int, ay: int, bx: int, by: int, radius_um: int) -> bool:
    """True when the two points are at most ``radius_um`` apart; exact."""
    return (ax - bx) ** 2 + (ay - by) ** 2 <= radius_um * radius_um
