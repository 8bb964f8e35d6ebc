"""Regions of an occupancy grid: areas in which a robot can drive without passing a narrow place.

1.  A cell's *clearance* is the distance of its middle to that of the nearest wall cell, as an exact
    squared number of cells, up to a cap. Beyond it all is wide.
2.  The grid is flooded from the widest cells down (a watershed; Beucher and Lantuéjoul 1979), those
    of one clearance row by row. A cell that touches no region begins one, whose *width* is its
    clearance. One that touches a region joins it: that of its neighbour with the largest clearance,
    ties to the right, the left, above, below, then the corners.
3.  Where a cell touches several regions, its own clearance is that of the passage between them.
    A region becomes one with the widest of them if the passage is at least `PASSAGE` of that
    region's own width, or if the region is narrower than `MIN_WIDTH_M` and so no room. Else the
    passage is a *narrow place*, and the two stay apart.

So there is no fixed width of doors: a door of 0.9 m parts a room from a corridor of 1.2 m, a
passage of two metres parts two halls, and a corridor is one region from end to end. Everything is
counted in integers, and ties go by index: the regions are the same on every machine.
"""

import math
from bisect import insort
from typing import Final

import numpy as np
from numpy.typing import NDArray

Walls = NDArray[np.bool_]
"""Shape (rows, columns), true where a cell is wall."""
Labels = NDArray[np.int32]

PASSAGE: Final = (7, 8)
"""A passage of this share of a region's width is no narrow place; docs/places.md says what it was
chosen on."""
CAP_M: Final = 2.0
MIN_WIDTH_M: Final = 0.4
NOWHERE: Final = -1
"""The region of wall cells."""


def clearance(walls: Walls, cap: int) -> NDArray[np.int32]:
    """The squared distance of each cell to the nearest wall cell, in cells²; ``cap``² at most.

    Two passes (Meijster et al. 2000): along columns, then the lowest of the parabolas of a row.
    """
    rows, columns = walls.shape
    along = np.full((rows, columns), cap, np.int32)
    along[walls] = 0
    for row in range(1, rows):
        np.minimum(along[row], along[row - 1] + 1, out=along[row])
    for row in range(rows - 2, -1, -1):
        np.minimum(along[row], along[row + 1] + 1, out=along[row])
    squared = along * along
    nearest = squared.copy()
    for shift in range(1, min(cap, columns)):
        reached = squared + shift * shift
        np.minimum(nearest[:, shift:], reached[:, :-shift], out=nearest[:, shift:])
        np.minimum(nearest[:, :-shift], reached[:, shift:], out=nearest[:, :-shift])
    limited: NDArray[np.int32] = np.minimum(nearest, cap * cap)
    return limited


def regions(walls: Walls, cell_m: float) -> Labels:
    """The region of each cell, numbered from 0 by their widest cell; `NOWHERE` for walls."""
    cap = max(2, math.ceil(CAP_M / cell_m))
    wide = np.zeros((walls.shape[0] + 2, walls.shape[1] + 2), np.int32)  # a border of wall
    wide[1:-1, 1:-1] = clearance(walls, cap)
    least = math.floor((MIN_WIDTH_M / cell_m) ** 2)
    flat = wide.ravel()
    order = np.argsort(-flat, kind="stable")[: int(np.count_nonzero(flat))]
    found = _flood(flat.tolist(), order.tolist(), wide.shape[1], least)
    return np.array(found, np.int32).reshape(wide.shape)[1:-1, 1:-1]


def _flood(wide: list[int], order: list[int], stride: int, least: int) -> list[int]:
    """The region of each cell of a grid in rows of ``stride``; cells come in ``order``."""
    around = (1, -1, stride, -stride, stride + 1, stride - 1, 1 - stride, -1 - stride)
    numerator, denominator = (part * part for part in PASSAGE)
    labels, parents, widths = [NOWHERE] * len(wide), list[int](), list[int]()

    def root(label: int) -> int:
        while parents[label] != label:
            parents[label] = parents[parents[label]]
            label = parents[label]
        return label

    for cell in order:
        passage, best, widest, touched = wide[cell], NOWHERE, -1, list[int]()
        for step in around:
            label = labels[cell + step]
            if label == NOWHERE:
                continue
            if wide[cell + step] > widest:
                widest, best = wide[cell + step], label
            if label not in touched:
                insort(touched, label)
        if best == NOWHERE:
            labels[cell] = len(parents)
            parents.append(len(parents))
            widths.append(passage)
            continue
        labels[cell] = best
        if len(touched) > 1:
            first, *others = sorted(
                {root(label) for label in touched}, key=lambda r: (-widths[r], r)
            )
            for other in others:
                width = widths[other]
                if passage * denominator >= width * numerator or width < least:
                    parents[other] = first
    numbers: dict[int, int] = {}
    return [
        NOWHERE if label == NOWHERE else numbers.setdefault(root(label), len(numbers))
        for label in labels
    ]
