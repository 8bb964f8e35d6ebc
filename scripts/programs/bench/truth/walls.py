"""The walls of generated buildings as occupancy maps, as a map server would publish them."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from eventsrc.envelope.occupancy_map import OCCUPIED, OccupancyMap

_BESIDE_M = 0.3
"""A border between rooms is wall where a wall is this near; rooms are drawn to the wall's middle or
to its face."""


@dataclass(frozen=True, slots=True)
class Walls:
    """The map of a building, and what share of the borders between its rooms are walls."""

    map: OccupancyMap
    walled: float


def world_names(generator: ModuleType) -> frozenset[str]:
    """The generated buildings."""
    return frozenset((*generator.DEVELOP, *generator.VALIDATE))


def world_walls(generator: ModuleType, world: str) -> Walls:
    """The walls of a building as the generator has them: no furniture, nothing unknown."""
    building = generator.World(world)
    cells = np.where(building.wall, OCCUPIED, 0).astype(np.uint8)
    x, y = map(float, building.lo)
    given = OccupancyMap(world, generator.RES, (x, y, 0.0), world, cells)
    return Walls(given, _walled(building.room, building.wall, generator.RES))


def _walled(rooms: Any, walls: Any, resolution: float) -> float:
    """The share of pairs of cells beside each other, of two rooms, that have a wall near."""
    near = _grown(walls, round(_BESIDE_M / resolution))
    borders = walled = 0
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        border = (rooms[one] != rooms[other]) & (rooms[one] >= 0) & (rooms[other] >= 0)
        borders += int(border.sum())
        walled += int((border & (near[one] | near[other])).sum())
    return walled / borders if borders else 0.0


def _grown(walls: Any, cells: int) -> Any:
    grown = walls.copy()
    for _ in range(cells):
        padded = np.pad(grown, 1)
        grown = grown | padded[2:, 1:-1] | padded[:-2, 1:-1] | padded[1:-1, 2:] | padded[1:-1, :-2]
    return grown
