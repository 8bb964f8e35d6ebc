"""Plane geometry in integer micrometres, and neighbourhoods other than plain distance."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from .deltas import Pose


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """``holds(a, b)`` says whether two poses are neighbours.

    It must be symmetric and pure. It is asked only for two poses that differ by at most
    ``reach_um`` in x and in y; others are none, and a pose is its own neighbour whatever it says.

    ``name`` stands for all of it in `Settings.neighbourhood`, and so in the fingerprint: a rule
    that would say otherwise of any two poses needs another name.
    """

    name: str
    reach_um: int
    holds: Callable[[Pose, Pose], bool]


def distance_um(ax: int, ay: int, bx: int, by: int) -> int:
    """The distance of two points, rounded down to whole micrometres."""
    return math.isqrt((ax - bx) ** 2 + (ay - by) ** 2)
