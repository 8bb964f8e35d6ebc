"""Within one session all cosines are higher than between two: made comparable, run by run.

Light, lens and clutter of a session are in every embedding of it, so a crop is more similar to what
its own session has mapped than the similarity model expects of anything. A map may hold a part of
the lost robot's own session beside other runs. Each run therefore has a shift of its own: taken off
the matches of all runs, the shift of one would make the others look as if seen from behind.

A shift shows where the crop's own side was mapped, because then cosines are higher than any between
two sessions. Where the own session saw a thing only from behind, they are as high as another
session's from in front, and the run stays open: in a landmark that several runs have seen, each run
is of the own session or not, whichever fits that landmark better (`settled`).
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
    """By how much the cosines against each run show to be higher than usual; mostly 0.

    A crop's third best match in the run tells, not the best: a crop that *is* in the map says
    nothing about others. A run with fewer matches of every crop tells nothing and is left alone;
    what is too similar then counts as a good match and no more (`Model.usual_best`).
    """
    thirds: dict[str, float] = {}
    for row in matches:
        for run_id, similarities in _by_run(row).items():
            third = similarities[_THIRD] if len(similarities) > _THIRD else 0.0
            thirds[run_id] = max(third, thirds.get(run_id, 0.0))
    return {run_id: max(0.0, third - model.usual_third) for run_id, third in thirds.items()}


def unshifted(row: Sequence[Match], shifts: Mapping[str, float]) -> list[Match]:
    """A crop's matches without their runs' shifts, most similar first, ties by ordinal."""
    if not any(shifts.values()):
        return list(row)
    taken = [_without(match, shifts[match.run_id]) for match in row]
    return sorted(taken, key=lambda match: (-match.similarity, match.observation))


def _by_run(row: Sequence[Match]) -> dict[str, list[float]]:
    found: dict[str, list[float]] = {}
    for match in row:
        found.setdefault(match.run_id, []).append(match.similarity)
    return found


def _without(match: Match, shift: float) -> Match:
    return replace(match, similarity=match.similarity - shift) if shift else match


@dataclass(frozen=True, slots=True, eq=False)
class Sessions:
    """Of each of n matches the number of its run, and what its shift lacks of a whole session's."""

    run: NDArray[np.intp]
    lacks: Floats

    def of(self, index: NDArray[np.intp]) -> "Sessions":
        """Those at ``index``."""
        return Sessions(self.run[index], self.lacks[index])

    @property
    def several(self) -> bool:
        """Whether there are matches of more than one run."""
        return bool((self.run != self.run[0]).any())


def sessions_of(matches: Sequence[Match], shifts: Mapping[str, float], model: Model) -> Sessions:
    """The sessions of matches whose ``shifts`` have been taken off."""
    numbers = {run_id: number for number, run_id in enumerate(sorted(shifts))}
    return Sessions(
        np.array([numbers[m.run_id] for m in matches], dtype=np.intp),
        np.array([max(0.0, model.session - shifts[m.run_id]) for m in matches]),
    )


def settled(error: Floats, sessions: Sessions, model: Model) -> tuple[Floats, Floats]:
    """The errors (directions, n) of one landmark's similarities with every run settled.

    For each direction a run counts as of the own session where that fits better by more than
    ``session_price``. The second result (directions,) is what was paid.
    """
    order = np.argsort(sessions.run, kind="stable")
    _, first, which, count = np.unique(
        sessions.run[order], return_index=True, return_inverse=True, return_counts=True
    )
    mean = np.add.reduceat(error[:, order], first, axis=1) / count
    lacks = sessions.lacks[order][first]
    variance = model.sigma_instance**2 + model.sigma_observation**2 / np.minimum(
        count, model.independent
    )
    gain = lacks * (2.0 * mean - lacks) / (2.0 * variance)
    own = gain > model.session_price
    taken = np.where(own, lacks, 0.0)[:, which]
    less = np.empty_like(error)
    less[:, order] = error[:, order] - taken
    return less, model.session_price * own.sum(1)
