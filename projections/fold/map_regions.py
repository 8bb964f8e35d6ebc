"""The regions of a grid with walls: areas in which a robot can drive without passing a narrow
place.

Everything is in integers.

1.  A cell's *clearance* is the distance of its middle to that of the nearest wall cell, as an exact
    squared number of cells, up to a cap. Beyond it all is wide.
2.  The grid is flooded from the widest cells down (a watershed; Beucher and Lantuéjoul 1979), those
    of one clearance row by row. A cell that touches no region begins one, whose *width* is its
    clearance. One that touches a region joins it: that of its neighbour with the largest clearance,
    ties to the right, the left, above, below, then the corners. The clearance of the cell with
    which a region comes to `USUAL_M2` is its *usual width*; before it has none.
3.  Where a cell touches several regions, its own clearance is that of the passage between them.
    A region becomes one with a wider one, the widest possible, if the passage is at least `PASSAGE`
    of its own width, or of the larger usual width of the two, if they have any; or if it is
    narrower than `MIN_WIDTH_M` and so no room. Else the passage is a *narrow place*, and the two
    stay apart. Two of which neither has a usual width, too small as yet to be told apart, become
    one. Two that become one keep the larger usual width; if neither has one and both together come
    to `USUAL_M2`, it is the passage.

So there is no fixed width of doors: a door of 0.9 m parts a room from a corridor of 1.2 m, a
passage of two metres parts two halls, and a corridor, which is wider beside doors and where another
crosses it, is one region from end to end.
"""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

Walls = NDArray[np.bool_]
"""Shape (rows, columns), true where a cell is wall."""
Labels = NDArray[np.int32]

PASSAGE: Final = (7, 8)
"""A passage of this share of a region's width is no narrow place; docs/places.md says what it was
chosen on."""
USUAL_M2: Final = 0.5
"""So much of a region's widest floor says how wide it usually is: a bulge has less."""
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


def regions(near: NDArray[np.int32], cell_m: float) -> Labels:
    """The region of each cell by its clearance, up to `clearance_cap`; numbered from 0 in the order
    of their first cells, `NOWHERE` for walls."""
    wide = np.pad(near, 1)  # a border of wall
    least, enough = math.floor((MIN_WIDTH_M / cell_m) ** 2), math.ceil(USUAL_M2 / cell_m**2)
    flat, stride = wide.ravel(), wide.shape[1]
    basins, summits = _basins(flat, stride)
    usual = _UsualWidths(flat, basins, len(summits), enough)
    merged = np.array(_merged(flat, stride, basins, flat[summits].tolist(), least, usual), np.int32)
    labels = np.full(flat.size, NOWHERE, np.int32)
    floor = np.flatnonzero(flat)
    own = merged[basins[floor]]
    first = np.full(len(merged), flat.size, np.int64)
    np.minimum.at(first, own, floor)
    kept = np.flatnonzero(first < flat.size)
    numbers = np.zeros(len(merged), np.int32)
    numbers[kept[np.argsort(first[kept])]] = np.arange(len(kept), dtype=np.int32)
    labels[floor] = numbers[own]
    return labels.reshape(wide.shape)[1:-1, 1:-1]


def clearance_cap(cell_m: float) -> int:
    """The clearance, in cells, from which all is wide."""
    return max(2, math.ceil(CAP_M / cell_m))


class _UsualWidths:
    """The usual width of each region, by its basin. Cells count by their turn in the flood."""

    def __init__(self, wide: Labels, basins: Labels, regions: int, enough: int) -> None:
        self._enough = enough
        floor = np.flatnonzero(wide)
        floor = floor[np.argsort(-wide[floor], kind="stable")]
        self._wide = wide[floor]
        self.turns = np.zeros(wide.size, np.int64)
        self.turns[floor] = np.arange(len(floor))
        by_basin = np.argsort(basins[floor], kind="stable")
        ends = np.searchsorted(basins[floor][by_basin], np.arange(regions + 1)).tolist()
        # Per region: the turns of its first cells; emptied when its usual width is in the next.
        self._first = [by_basin[a : min(b, a + enough)].tolist() for a, b in pairwise(ends)]
        self._known = [0] * regions

    def at(self, region: int, turn: int) -> int:
        """The usual width of a region after a turn; 0 for none."""
        first = self._first[region]
        if len(first) == self._enough and first[-1] <= turn:
            self._known[region] = int(self._wide[first[-1]])
            first.clear()
        return self._known[region]

    def merge(self, region: int, other: int, turn: int) -> None:
        """Make another region part of a region in a turn; both have been asked for theirs."""
        known = max(self._known[region], self._known[other])
        both = sorted((*self._first[region], *self._first[other]))[: self._enough]
        if not known and len(both) == self._enough and both[-1] <= turn:
            known = int(self._wide[turn])
        self._known[region], self._first[region] = known, [] if known else both


def _before(wide: Labels, stride: int) -> Iterator[tuple[int, Walls, Labels]]:
    """For each neighbour of the inner cells of a grid in rows of ``stride``, in the order of rule
    2: the step there, whether it is flooded before the cell, and its clearance."""
    inner = slice(stride + 1, wide.size - stride - 1)
    for step in (1, -1, stride, -stride, stride + 1, stride - 1, 1 - stride, -1 - stride):
        beside = wide[inner.start + step : inner.stop + step]
        yield step, (beside > wide[inner] if step > 0 else beside >= wide[inner]), beside


def _basins(wide: Labels, stride: int) -> tuple[Labels, NDArray[np.intp]]:
    """What each cell joins when it is flooded, if nothing ever merges: the basins' numbers, in the
    order in which they begin, and the cells that they begin with."""
    cells = np.arange(wide.size, dtype=np.int32)
    widest, best = np.full(wide.size - 2 * stride - 2, -1, np.int32), cells.copy()
    inner = best[stride + 1 : wide.size - stride - 1]
    for step, is_before, beside in _before(wide, stride):
        better = is_before & (beside > widest)
        np.copyto(widest, beside, where=better)
        np.copyto(inner, cells[stride + 1 + step : wide.size - stride - 1 + step], where=better)
    best[wide == 0] = 0
    while not np.array_equal(further := best[best], best):
        best = further
    summits = np.flatnonzero((best == cells) & (wide > 0))
    summits = summits[np.argsort(-wide[summits], kind="stable")]
    numbers = np.full(wide.size, NOWHERE, np.int32)
    numbers[summits] = np.arange(len(summits))
    return numbers[best], summits


def _merged(
    wide: Labels,
    stride: int,
    basins: Labels,
    widths: list[int],
    least: int,
    usual: _UsualWidths,
) -> list[int]:
    """Merge basins by rule 3; returns the one that each is part of. ``widths`` are theirs.

    Where a cell touches just two basins that touched before, nothing merges: their passage was
    wider then, the narrower of them is no narrower now, and no usual width has become less.
    """
    inner = slice(stride + 1, wide.size - stride - 1)
    cells, others = list[NDArray[np.intp]](), list[Labels]()
    for step, is_before, _ in _before(wide, stride):
        beside = basins[inner.start + step : inner.stop + step]
        found = np.flatnonzero(is_before & (beside != basins[inner]) & (wide[inner] > 0))
        cells.append(found + inner.start)
        others.append(beside[found])
    cell, other = np.concatenate(cells), np.concatenate(others).astype(np.int64)
    touches = np.unique(cell * len(widths) + other)
    cell, other = touches // max(len(widths), 1), touches % max(len(widths), 1)
    order = np.argsort(-wide[cell], kind="stable")
    cell, other = cell[order], other[order]
    own = basins[cell].astype(np.int64)
    pairs = np.minimum(own, other) * len(widths) + np.maximum(own, other)
    is_news = np.zeros(len(cell), np.bool_)
    is_news[np.unique(pairs, return_index=True)[1]] = True
    again = cell[1:] == cell[:-1]
    is_news[1:] |= again
    is_news[:-1] |= again
    touched = dict[int, list[int]]()
    for at, beside in zip(cell[is_news].tolist(), other[is_news].tolist(), strict=True):
        touched.setdefault(at, [int(basins[at])]).append(beside)
    parents = list(range(len(widths)))

    def root(label: int) -> int:
        while parents[label] != label:
            parents[label] = parents[parents[label]]
            label = parents[label]
        return label

    numerator, denominator = (part * part for part in PASSAGE)
    for at, labels in touched.items():
        passage, turn = int(wide[at]), int(usual.turns[at])
        apart = list[int]()
        for each in sorted({*map(root, labels)}, key=lambda r: (-widths[r], r)):
            for wider in apart:
                width = min(widths[each], max(usual.at(wider, turn), usual.at(each, turn)))
                if passage * denominator >= width * numerator or widths[each] < least:
                    parents[each] = wider
                    usual.merge(wider, each, turn)
                    break
            else:
                apart.append(each)
    return list(map(root, parents))
