"""Decision: choose the answer among the weighed positions.

The one with the least expected error, errors above 4 m counting as 4 m (like a median; a mean could
lie between two look-alike spots). A fifth of that expectation is over the positions of robots at
the ten observations most similar to each crop. This fifth decides where the weights are spread over
half the building, as with one crop of a thing that the map has many of, and hardly matters
elsewhere.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from .camera import Floats
from .candidates import Match
from .question import View

MAX_ERROR_M: Final = 4.0
PLAIN_SHARE: Final = 0.2
PLAIN_NEAREST: Final = 10


def stood_at(views: Sequence[View], matches: Sequence[Sequence[Match]]) -> Floats:
    """Positions (n, 2) of robots at the observations most similar to each crop with an embedding;
    ``matches`` run parallel to the crops of all views."""
    crops = [crop for view in views for crop in view.crops]
    found = [
        match.pose[:2]
        for crop, row in zip(crops, matches, strict=True)
        if crop.vector is not None
        for match in row[:PLAIN_NEAREST]
        if match.pose is not None
    ]
    return np.array(found, dtype=np.float64).reshape(-1, 2)


def least_error(cells: Floats, weights: Floats, stood: Floats) -> int:
    """The index of the cell (h, 2) with the least expected error. ``weights`` (h,) add up to 1;
    ``stood`` (n, 2) is of `stood_at`."""
    expected = (np.minimum(_apart(cells, cells), MAX_ERROR_M) * weights[None]).sum(1)
    if len(stood):
        plain = np.minimum(_apart(cells, stood), MAX_ERROR_M).mean(1)
        expected += PLAIN_SHARE / (1.0 - PLAIN_SHARE) * plain
    return int(np.argmin(expected))


def _apart(one: Floats, other: Floats) -> Floats:
    """The distances between positions ``one`` (n, 2) and ``other`` (m, 2), of shape (n, m)."""
    dx = one[:, 0, None] - other[None, :, 0]
    dy = one[:, 1, None] - other[None, :, 1]
    dx *= dx
    dy *= dy
    dx += dy
    found: Floats = np.sqrt(dx, out=dx)
    return found
