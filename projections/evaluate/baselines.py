"""Baselines of re-localisation, which every score is compared with.

*Plain*: the ten observations most similar to each crop; the answer is the median of where their
robots stood, in x and y each. *Best cosine*: the greatest cosine of a crop and an observation; the
greater it is, the likelier the map knows the thing.
"""

from collections.abc import Sequence

import numpy as np

from projections.relocalize import Match

NEAREST = 10


def plain_position(matches: Sequence[Sequence[Match]]) -> tuple[float, float] | None:
    """Metres; None if none of the nearest observations has a pose."""
    poses = [m.pose[:2] for row in matches for m in row[:NEAREST] if m.pose is not None]
    if not poses:
        return None
    x, y = np.median(np.array(poses), axis=0)
    return float(x), float(y)


def best_cosine(matches: Sequence[Sequence[Match]]) -> float:
    """The greatest cosine of all crops; -1 if the map has no observation."""
    return max((row[0].similarity for row in matches if row), default=-1.0)
