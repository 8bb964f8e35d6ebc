"""Baselines of re-localisation, with which scores are compared.

*Plain*: the ten observations most similar to each crop; the answer is the median of their robots'
positions, in x and y each. *Best cosine*: the greatest cosine of a crop and an observation, as a
score of whether the thing is in the map.
"""

from collections.abc import Sequence

import numpy as np

from projections.localize.relocalize import Match

NEAREST = 10


def plain_position(matches: Sequence[Sequence[Match]]) -> tuple[float, float] | None:
    """The plain position in metres; None if none of the nearest observations has a pose."""
    poses = [m.pose[:2] for row in matches for m in row[:NEAREST] if m.pose is not None]
    if not poses:
        return None
    x, y = np.median(np.array(poses), axis=0)
    return float(x), float(y)


def best_cosine(matches: Sequence[Sequence[Match]]) -> float:
    """The greatest cosine of all crops; -1 if the map has no observation."""
    return max((row[0].similarity for row in matches if row), default=-1.0)
