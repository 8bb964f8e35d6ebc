"""The walls of a simulated house as an occupancy map, as its map server would publish them."""

import numpy as np

from eventsrc.occupancy_map import OCCUPIED, OccupancyMap

from .house import House

_RESOLUTION_M = 0.05
_MARGIN = 10
"""Cells around the outermost walls."""


def occupancy_map(house: House) -> OccupancyMap:
    """Walls only: no furniture, nothing unknown. A wall takes the cells that its line is in."""
    lines = [(w.x0, w.y0, w.x1, w.y1) for w in house.plan.walls]
    left = _cell(min(min(x0, x1) for x0, _, x1, _ in lines)) - _MARGIN
    below = _cell(min(min(y0, y1) for _, y0, _, y1 in lines)) - _MARGIN
    columns = _cell(max(max(x0, x1) for x0, _, x1, _ in lines)) - left + _MARGIN + 1
    rows = _cell(max(max(y0, y1) for _, y0, _, y1 in lines)) - below + _MARGIN + 1
    cells = np.zeros((rows, columns), np.uint8)
    for line in lines:
        x0, y0, x1, y1 = map(_cell, line)
        spans = sorted((y0 - below, y1 - below)), sorted((x0 - left, x1 - left))
        cells[spans[0][0] : spans[0][1] + 1, spans[1][0] : spans[1][1] + 1] = OCCUPIED
    origin = round(left * _RESOLUTION_M, 6), round(below * _RESOLUTION_M, 6), 0.0
    return OccupancyMap(f"house-{house.seed}", _RESOLUTION_M, origin, "simulated house", cells)


def _cell(metres: float) -> int:
    """The number of a cell; walls lie on tenths of a millimetre, so the division is safe."""
    return round(metres * 10_000) // round(_RESOLUTION_M * 10_000)
