"""The grid under DBSCAN: square cells so small that whoever shares one is a neighbour.

Two points of a half-open integer cell of side s differ by at most s - 1 in each axis, so with
s = ⌊√(ε²/2)⌋ + 1 they are within ε. As 2s > ε√2, a neighbour is at most two cells away in each
axis, and not in the corners of that 5 × 5 block: 20 cells beside the point's own (Gan and Tao,
"DBSCAN Revisited", SIGMOD 2015).
"""

import math

NEIGHBOUR_CELLS = tuple(
    (dx, dy)
    for dx in range(-2, 3)
    for dy in range(-2, 3)
    if (dx, dy) != (0, 0) and abs(dx) + abs(dy) < 4
)


def cell_side_um(eps_um: int) -> int:
    """The side of a cell for ε, both in micrometres."""
    return math.isqrt(eps_um * eps_um // 2) + 1
