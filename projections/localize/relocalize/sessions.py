"""Session shifts: subtract the excess of likenesses within one session over those between two.

Light, lens and clutter of a session are in all of its embeddings, so a crop is more similar to what
its own session has mapped than the same thing is on another day: by ``session_shift`` of
`projections.fold.evidence`. A map may hold a part of the lost robot's own session beside other
runs. Each run therefore has a shift of its own: with one shift subtracted from all, the other runs'
matches would be as dissimilar as views from behind.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from .camera import Floats
from .candidates import Match

_THIRD = 2


def session_shifts(
    rows: Sequence[Sequence[Match]], likenesses: Sequence[Floats], usual: float, most: float
) -> dict[str, float]:
    """The shift of each run: the excess of its likenesses over ``usual``, at most ``most``; mostly
    0.

    Measured on a crop's third best match in the run, not the best, which is too similar if the very
    crop is in the map. A run with fewer matches of every crop has shift 0.
    """
    thirds: dict[str, float] = {}
    for row, likeness in zip(rows, likenesses, strict=True):
        by_run: dict[str, list[float]] = {}
        for match, value in zip(row, likeness.tolist(), strict=True):
            by_run.setdefault(match.run_id, []).append(value)
        for run_id, values in by_run.items():
            third = sorted(values)[-_THIRD - 1] if len(values) > _THIRD else usual
            thirds[run_id] = max(third, thirds.get(run_id, usual))
    return {run_id: min(third - usual, max(0.0, most)) for run_id, third in thirds.items()}


def subtract_shifts(row: Sequence[Match], likeness: Floats, shifts: Mapping[str, float]) -> Floats:
    """A crop's likenesses less their runs' shifts."""
    if not any(shifts.values()):
        return likeness
    less: Floats = likeness - np.array([shifts[match.run_id] for match in row])
    return less
