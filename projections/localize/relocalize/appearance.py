"""Appearance: log-likelihood ratios of a landmark being the crop, by the likeness of its
observations.

Two parts, each a log-likelihood ratio for every direction from which the robot may look.

*Which thing*: a likeness u of the same thing is normally distributed about μ(Δ) = same_back +
same_side · exp(κ (cos Δ − 1)) − session_shift, and flat above; Δ is the change of side. Different
things are a mixture of look-alikes (a little below μ), other things of the class, and others. Of a
landmark's observations the four best count, by their mean (`projections.fold.looks` decides
likewise).

*Which side*: the likenesses of all observations of a landmark fall together with the change of
side. A common offset, as of a crop from another day or with a hidden half, is no evidence of the
side, so the spread about their mean counts more than the mean. This part is a density over
directions: its mean is 1.

An observation with a likeness of nearly 1 is the crop's own picture. Then its landmark is the
thing, and the robot is on that side of it.

*Session shifts* are taken off likenesses first: the excess within one session over those between
two. Light, lens and clutter of a session are in all of its embeddings, so a crop is more similar to
what its own session has mapped than the same thing is on another day: by ``session_shift`` of
`projections.fold.evidence`. A map may hold a part of the lost robot's own session beside other
runs. Each run therefore has a shift of its own: with one shift subtracted from all, the other runs'
matches would be as dissimilar as views from behind.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from projections.fold.evidence import EvidenceConstants

from .camera import Floats
from .candidates import Match
from .constants import MapConstants, RankingModel

DIRECTIONS: Final = 36
"""The number of directions in a landmark's table, 10° apart."""
_STEPS: Final = 32
_LEAST_LIKENESS, _PER_LIKENESS, _LIKENESSES = -1.0, 128.0, 289
_WORST: Final = 8.0
_TURN: Final = 2.0 * math.pi
_ANGLES: Final = np.arange(DIRECTIONS) * (_TURN / DIRECTIONS)

Indices = NDArray[np.intp]


def relative(cosines: Floats, constants: MapConstants) -> Floats:
    """Relative likenesses of cosines: 0 for different things of different classes, 1 for the same
    picture."""
    return (cosines - constants.different) / (1.0 - constants.different)


def usual_likeness(evidence: EvidenceConstants) -> float:
    """The usual likeness of one thing in two runs, seen from the same side."""
    return evidence.same_back + evidence.same_side - evidence.session_shift


def appearance_tables(
    likeness: Floats, side: Floats, starts: Indices, constants: MapConstants, model: RankingModel
) -> Floats:
    """Log-likelihood ratios of shape (landmarks, DIRECTIONS). ``likeness`` and ``side``, the angle
    from which it was seen in radians, are of the observations, grouped by landmark; ``starts`` has
    the index of each landmark's first."""
    evidence = constants.evidence
    cosines = np.cos(_ANGLES[:, None] - side[None])
    same = np.minimum(likeness, model.same_picture)
    tables = _which_thing(same, cosines, starts, constants, model)
    tables += model.side_weight * _which_side(same, cosines, starts, evidence, model)
    tables = np.minimum(tables, model.most)
    very = likeness > model.same_picture
    if very.any():
        beside = np.where(very[None], model.same_picture_kappa * (cosines - 1.0), -math.inf)
        beside = np.maximum(np.maximum.reduceat(beside, starts, axis=1), -_WORST).T
        of_it = np.logical_or.reduceat(very, starts)
        tables = np.where(of_it[:, None], model.most + beside, tables)
    return tables


def _which_thing(
    likeness: Floats, cosines: Floats, starts: Indices, constants: MapConstants, model: RankingModel
) -> Floats:
    place = np.rint((likeness - _LEAST_LIKENESS) * _PER_LIKENESS)
    place = np.minimum(np.maximum(place, 0.0), _LIKENESSES - 1.0)
    step = np.rint((cosines + 1.0) * (_STEPS / 2))
    spread = constants.different_spread / (1.0 - constants.different)
    ratios = _ratios(_key(constants.evidence), spread, model)
    ratios = ratios.take((step * _LIKENESSES + place[None]).astype(np.intp))
    ends = [*starts[1:].tolist(), len(likeness)]
    found = np.empty((len(starts), DIRECTIONS))
    for row, (start, end) in enumerate(zip(starts.tolist(), ends, strict=True)):
        part = ratios[:, start:end]
        missing = model.best_pairs - (end - start)
        if missing < 0:
            part = np.partition(part, -missing, axis=1)[:, -model.best_pairs :]
        found[row] = (part.sum(1) - model.missing * max(0, missing)) / model.best_pairs
    return found


_Key = tuple[float, ...]


def _key(evidence: EvidenceConstants) -> _Key:
    e = evidence
    return (
        e.same_back, e.same_side, e.same_kappa, e.same_spread, e.session_shift,
        e.same_class, e.same_class_spread,
    )  # fmt: skip


@lru_cache(maxsize=16)
def _ratios(key: _Key, different_spread: float, model: RankingModel) -> Floats:
    """The table of log-likelihood ratios of single pairs, by change of side and by likeness."""
    back, side, kappa, spread, shift, of_class, class_spread = key
    sides = np.exp(kappa * (np.arange(_STEPS + 1) * (2.0 / _STEPS) - 2.0))
    below = np.arange(_LIKENESSES) / _PER_LIKENESS + _LEAST_LIKENESS
    likeness, mean = below[None], (back - shift + side * sides)[:, None]
    same = np.minimum((likeness - mean) / spread, 0.0)
    alike = np.minimum((likeness - mean + model.look_alike_below) / spread, 0.0)
    others = 1.0 - model.look_alike - model.of_class
    different = (
        model.look_alike * np.exp(-0.5 * alike * alike)
        + model.of_class * spread / class_spread * _bell((likeness - of_class) / class_spread)
        + others * spread / different_spread * _bell(likeness / different_spread)
    )
    ratios: Floats = np.maximum(-0.5 * same * same, -_WORST) - np.log(different)
    return ratios


def _bell(z: Floats) -> Floats:
    return np.exp(-0.5 * np.minimum(z * z, 200.0))


def _which_side(
    likeness: Floats,
    cosines: Floats,
    starts: Indices,
    evidence: EvidenceConstants,
    model: RankingModel,
) -> Floats:
    """Log-likelihoods of shape (landmarks, DIRECTIONS), whose exponentials have the mean 1."""
    mean = usual_likeness(evidence) + evidence.same_side * (
        np.exp(evidence.same_kappa * (cosines - 1.0)) - 1.0
    )
    error = likeness[None] - mean
    count = np.diff(np.append(starts, len(likeness))).astype(np.float64)
    common = np.add.reduceat(error, starts, axis=1) / count
    scatter = np.add.reduceat(error * error, starts, axis=1) / count - common * common
    variance = max(evidence.same_spread, model.least_spread) ** 2
    number = np.minimum(count, model.independent)
    own = model.own_spread * variance
    fit = -0.5 * (scatter * (number / own) + common * common / ((variance - own) + own / number))
    fit = np.maximum(fit - fit.max(0), -_WORST)
    density: Floats = (fit - np.log(np.exp(fit).mean(0))).T
    return density


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
