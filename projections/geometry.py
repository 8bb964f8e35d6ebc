"""When two poses are neighbours, if not by plain distance."""

from collections.abc import Callable
from dataclasses import dataclass

from .deltas import Pose


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """``holds(a, b)`` says whether two poses are neighbours.

    It must be symmetric, pure, and false beyond ``reach_um`` in x or y. A pose is its own
    neighbour whatever it says.
    """

    reach_um: int
    holds: Callable[[Pose, Pose], bool]
