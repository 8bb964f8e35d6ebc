"""Session shifts: how much higher cosines are within one session than between two, subtracted.

Light, lens and clutter of a session are in all of its embeddings, so a crop is more similar to what
its own session has mapped than the similarity model expects. A map may hold a part of the lost
robot's own session beside other runs. Each run therefore has a shift of its own: with the shift of
one subtracted from all, the other runs' matches would look as if seen from behind.

A shift can be measured where the side that the crop shows was mapped: cosines are then higher than
any between two sessions (`session_shifts`). Where the own session saw a thing only from behind, its
cosines are as high as another session's from in front, so it stays open which run is of the own
session: for a landmark that several runs have seen, each run is taken to be of the own session or
not, whichever fits that landmark better (`apply_remaining_shifts`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .camera import Floats
from .candidates import Match
from .model import Model

_THIRD = 2


def session_shifts(matches: Sequence[Sequence[Match]], model: Model) -> dict[str, float]:
    """By run, how much higher than usual its cosines are; mostly 0.

    Measured on a crop's third best match in the run, not the best, which is too similar if the very
    crop is in the map. A run with fewer matches of every crop has shift 0; similarities above
    `Model.usual_best` then count as that.
    """
    thirds: dict[str, float] = {}
    for row in matches:
        for run_id, similarities in _by_run(row).items():
            third = similarities[_THIRD] if len(similarities) > _THIRD else 0.0
            thirds[run_id] = max(third, thirds.get(run_id, 0.0))
    return {run_id: max(0.0, third - model.usual_third) for run_id, third in thirds.items()}


def _by_run(row: Sequence[Match]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for match in row:
        found.setdefault(match.run_id, []).append(match.similarity)
    return found


def subtract_shifts(row: Sequence[Match], shifts: Mapping[str, float]) -> list[Match]:
    """A crop's matches less their runs' shifts, most similar first, ties by ordinal."""
    if not any(shifts.values()):
        return list(row)
    shifted = [_subtract(match, shifts[match.run_id]) for match in row]
    return sorted(shifted, key=lambda match: (-match.similarity, match.observation))


def _subtract(match: Match, shift: float) -> Match:
    return replace(match, similarity=match.similarity - shift) if shift else match


@dataclass(frozen=True, slots=True, eq=False)
class RemainingShifts:
    """For n matches: run numbers, and the parts of a session's shift not yet subtracted."""

    run: NDArray[np.intp]
    shift: Floats

    def subset(self, index: NDArray[np.intp]) -> "RemainingShifts":
        """Those at ``index``."""
        return RemainingShifts(self.run[index], self.shift[index])


def remaining_shifts(
    matches: Sequence[Match], shifts: Mapping[str, float], model: Model
) -> RemainingShifts:
    """What remains for matches from which ``shifts`` have been subtracted."""
    numbers = {run_id: number for number, run_id in enumerate(sorted(shifts))}
    return RemainingShifts(
        np.array([numbers[m.run_id] for m in matches], dtype=np.intp),
        np.array([max(0.0, model.session - shifts[m.run_id]) for m in matches]),
    )


def apply_remaining_shifts(
    error: Floats, remaining: RemainingShifts, model: Model
) -> tuple[Floats, Floats]:
    """Subtract the remaining shift of a run where one landmark's similarities then fit better.

    ``error`` of shape (directions, n) is similarity less the expected one. For each direction a run
    counts as of the own session where that fits better by more than ``session_price``; matches of
    one run alone are left as they are. Returns the errors after it, and the prices (directions,).
    """
    if (remaining.run == remaining.run[0]).all():
        return error, np.zeros(len(error))
    order = np.argsort(remaining.run, kind="stable")
    _, first, which, count = np.unique(
        remaining.run[order], return_index=True, return_inverse=True, return_counts=True
    )
    mean = np.add.reduceat(error[:, order], first, axis=1) / count
    shift = remaining.shift[order][first]
    variance = model.sigma_instance**2 + model.sigma_observation**2 / np.minimum(
        count, model.independent
    )
    gain = shift * (2.0 * mean - shift) / (2.0 * variance)
    own = gain > model.session_price
    subtracted = np.where(own, shift, 0.0)[:, which]
    less = np.empty_like(error)
    less[:, order] = error[:, order] - subtracted
    return less, model.session_price * own.sum(1)
