"""Poses: weigh where the robot may be, at the last view of a question, and choose.

The posterior is a grid of cells of 0.35 m near positions from which a landmark was seen, times
headings. Of all cells within 1.6 m those are kept that fit best whatever the heading, by cells of
0.7 m first. In each, the headings are those that put one of the likeliest landmarks of a crop where
the crop shows it: nodes of an integral over all headings, each weighing its likelihood divided by
how densely they lie. What holds for every heading is taken off at the nodes, and added once. A
pose's likelihood is the product over crops of their mixtures (`likelihood`); the prior is that
robots drive where robots have driven (`grid`).

Several views: each pose at the last view gives a pose at every view before (`movements`).

The answer is the cell with the least expected error, errors above 2.5 m counting as 2.5 m (like a
median; a mean could lie between two look-alike spots), moved to the mean of the weights near it,
which is then computed anew on a grid of 0.12 m.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .appearance import usual_likeness
from .camera import Floats
from .candidates import Match
from .features import Features, confidence_of, features_of
from .grid import cells_near, likely_spots, log_prior
from .landmarks import CropEvidence, crop_evidence, likeness_of
from .likelihood import (
    Scene,
    Terms,
    headings,
    log_likelihood,
    log_likelihood_of_place,
    log_likelihood_unaimed,
    terms_at,
)
from .movements import Behind, Movement, behind_last, poses_at_views
from .question import View
from .sessions import session_shifts

Indices = NDArray[np.intp]
_TermsOfViews = Sequence[Sequence[Terms]]

CELL_M: Final = 0.35
_COARSE_KEPT, _COARSE_IN_ALL = 40, 96
_KEPT, _IN_ALL = 100, 240
"""So many cells are kept, and with few crops, which leave more open, so many for all together."""
_HEADINGS: Final = 8
_TURN: Final = 2.0 * math.pi
_FINE_M: Final = 0.12
_FINE: Final = np.arange(-3, 4) * _FINE_M
_FINE_YAW: Final = np.array([-0.16, -0.08, 0.0, 0.08, 0.16])
_MAX_ERROR_M: Final = 2.5
_NEAR_M: Final = 1.0
_MIN_YAW_AGREEMENT: Final = 0.8
_SAME_SPOT_M: Final = 0.05
_LEAST_WEIGHT: Final = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """``poses`` (h, 3), one for each cell, with ``weights`` (h,) that add up to 1, likeliest first.

    ``x``, ``y`` and ``yaw`` (None when the evidence leaves it open) are the answer; ``spread_m``
    is the root mean square distance of all poses from it.
    """

    poses: Floats
    weights: Floats
    x: float
    y: float
    yaw: float | None
    spread_m: float
    features: Features
    confidence: float


@dataclass(frozen=True, slots=True, eq=False)
class _Sighted:
    """The crops of a view that have evidence, and the movement since the view before."""

    crops: tuple[CropEvidence, ...]
    movement: Movement


def locate(
    views: Sequence[View], matches: Sequence[Sequence[Match]], scene: Scene
) -> Posterior | None:
    """The posterior over poses at the last view; ``matches`` run parallel to the crops of all
    views. None if no match has a pose."""
    sighted = _sighted(views, matches, scene)
    crops = [crop for view in sighted for crop in view.crops]
    if not crops:
        return None
    behind = behind_last([view.movement for view in sighted])
    been = likely_spots([crop.landmarks for crop in crops], CELL_M / 2)
    coarse = cells_near(been, 2.0 * CELL_M, scene.model.reach_m)
    score, _ = _score_places(coarse, sighted, behind, been, 2.0 * CELL_M, scene)
    kept = _best(score, max(_COARSE_KEPT, _COARSE_IN_ALL // len(crops)))
    quarter = CELL_M / 2
    corners = np.array([(x, y) for x in (-quarter, quarter) for y in (-quarter, quarter)])
    cells = (coarse[kept][:, None] + corners[None]).reshape(-1, 2)
    score, terms = _score_places(cells, sighted, behind, been, CELL_M, scene)
    kept = _best(score, max(_KEPT, _IN_ALL // len(crops)))
    terms = [[each.take(kept) for each in of_view] for of_view in terms]
    return _weigh(cells[kept], terms, sighted, behind, been, len(matches), scene)


def _sighted(
    views: Sequence[View], matches: Sequence[Sequence[Match]], scene: Scene
) -> list[_Sighted]:
    constants, evidence = scene.constants, scene.constants.evidence
    crops = [crop for view in views for crop in view.crops]
    likeness = [likeness_of(c, row, constants) for c, row in zip(crops, matches, strict=True)]
    pictures = [i for i, crop in enumerate(crops) if crop.vector is not None and not crop.is_text]
    shifts = session_shifts(
        [matches[i] for i in pictures],
        [likeness[i] for i in pictures],
        usual_likeness(evidence) + evidence.same_spread,
        evidence.session_shift,
    )
    rows = iter(zip(crops, matches, likeness, strict=True))
    found = []
    for view in views:
        of_view = [
            crop_evidence(
                *next(rows),
                shifts if crop.vector is not None and not crop.is_text else {},
                constants,
                scene.camera,
                scene.model,
            )
            for crop in view.crops
        ]
        present = tuple(crop for crop in of_view if crop is not None)
        found.append(_Sighted(present, (view.dx, view.dy, view.dyaw)))
    return found


def _score_places(
    xy: Floats,
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    been: Floats,
    cell_m: float,
    scene: Scene,
) -> tuple[Floats, _TermsOfViews]:
    """The log-likelihood of cells whatever the heading, and the terms there. A view from elsewhere
    counts as one from here with a larger error."""
    total = log_prior(xy, been, scene.model, scene.walls)
    found = []
    for view, back in zip(sighted, behind, strict=True):
        error = cell_m * cell_m / 12.0 + back.m2 + 0.5 * back.away_m**2
        of_view = [terms_at(crop, xy, error, scene) for crop in view.crops]
        for crop, terms in zip(view.crops, of_view, strict=True):
            total += log_likelihood_of_place(crop, terms, scene)
        found.append(of_view)
    return total, found


def _best(score: Floats, count: int) -> Indices:
    return np.argsort(-score, kind="stable")[:count]


def _weigh(
    cells: Floats,
    terms: _TermsOfViews,
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    been: Floats,
    asked: int,
    scene: Scene,
) -> Posterior:
    prior = log_prior(cells, been, scene.model, scene.walls)
    error = CELL_M * CELL_M / 12.0
    which, yaw, density = _hypotheses(sighted, behind, terms, scene)
    poses = np.column_stack((cells[which], yaw))
    each = np.stack(list(_crop_likelihoods(poses, which, sighted, behind, terms, error, scene)))
    anywhere = prior.copy()
    for of_view in terms:
        for there in of_view:
            anywhere += log_likelihood_unaimed(there, scene)
    score = each.sum(0) + prior[which]
    most = max(float(score.max()), float(anywhere.max()))
    rest = np.exp(anywhere - most)
    weights = np.maximum(np.exp(score - most) - rest[which], 0.0) / density
    of_cell = weights.reshape(-1, len(cells)).sum(0) + _TURN * (len(which) // len(cells)) * rest
    weights, of_cell = weights / of_cell.sum(), of_cell / of_cell.sum()
    return _choose(cells, of_cell, poses, which, weights, each, sighted, behind, been, asked, scene)


def _hypotheses(
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    terms: _TermsOfViews,
    scene: Scene,
) -> tuple[Indices, Floats, Floats]:
    """Headings at the cells: the cell's index, the heading at the last view, and how densely the
    headings of that cell lie there."""
    found = []
    for view, back, of_view in zip(sighted, behind, terms, strict=True):
        for crop, each in zip(view.crops, of_view, strict=True):
            yaw, variance, weight = headings(crop, each, scene)
            found.append((yaw + back.turn, variance + back.yaw2, weight))
    yaws, variances, weights = (np.concatenate(part) for part in zip(*found, strict=True))
    chosen = np.argsort(-weights, axis=0, kind="stable")[:_HEADINGS]
    yaw = np.take_along_axis(yaws, chosen, 0)
    variance = np.take_along_axis(variances, chosen, 0)
    off = yaw[:, None] - yaw[None]
    off -= _TURN * np.rint(off / _TURN)
    bells = np.exp(-0.5 * np.minimum(off * off / variance[None], 40.0))
    density = (bells / np.sqrt(_TURN * variance)[None]).mean(1)
    which = np.tile(np.arange(yaw.shape[1]), len(yaw))
    return which, yaw.ravel(), density.ravel()


def _crop_likelihoods(
    poses: Floats,
    which: Indices,
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    terms: _TermsOfViews,
    error: float,
    scene: Scene,
) -> Iterator[Floats]:
    """The log-likelihood of each crop at poses of the last view. ``terms`` at the positions that
    ``which`` names serve the views from the same spot."""
    at_views = poses_at_views(poses, [view.movement for view in sighted])
    for number, (view, back, here) in enumerate(zip(sighted, behind, at_views, strict=True)):
        for index, crop in enumerate(view.crops):
            if back.away_m < _SAME_SPOT_M:
                there = terms[number][index].take(which)
            else:
                there = terms_at(crop, here[:, :2], error + back.m2, scene)
            yield log_likelihood(crop, there, here[:, 2], back.yaw2, scene)


def _choose(
    cells: Floats,
    of_cell: Floats,
    poses: Floats,
    which: Indices,
    weights: Floats,
    each: Floats,
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    been: Floats,
    asked: int,
    scene: Scene,
) -> Posterior:
    apart = np.sqrt(
        (cells[:, 0, None] - cells[None, :, 0]) ** 2 + (cells[:, 1, None] - cells[None, :, 1]) ** 2
    )
    expected = (np.minimum(apart, _MAX_ERROR_M) * of_cell[None]).sum(1)
    best = int(np.argmin(expected))
    near = np.maximum(of_cell, _LEAST_WEIGHT) * (apart[best] < _NEAR_M)
    x, y = (float((cells[:, axis] * near).sum() / near.sum()) for axis in (0, 1))
    close = np.maximum(weights, _LEAST_WEIGHT) * near[which].astype(np.bool_)
    yaw = _mean_yaw(poses[:, 2], close / close.sum())
    x, y = _refine(x, y, float(poses[int(np.argmax(close)), 2]), sighted, behind, been, scene)
    likeliest = int(np.argmax(weights))
    squared = (cells[:, 0] - x) ** 2 + (cells[:, 1] - y) ** 2
    crops = [crop for view in sighted for crop in view.crops]
    found = features_of(
        [crop.landmarks for crop in crops if crop.has_look],
        each[:, likeliest],
        asked,
        float(of_cell[squared < 1.5**2].sum()),
        float((np.minimum(np.sqrt(squared), _MAX_ERROR_M) * of_cell).sum()),
        scene.model,
    )
    order = np.argsort(-of_cell, kind="stable")
    heaviest = weights.reshape(-1, len(cells)).argmax(0) * len(cells) + np.arange(len(cells))
    return Posterior(
        poses[heaviest[order]],
        of_cell[order],
        x,
        y,
        yaw,
        math.sqrt(float((squared * of_cell).sum())),
        found,
        confidence_of(found, scene.constants.localizer),
    )


def _refine(
    x: float,
    y: float,
    yaw: float,
    sighted: Sequence[_Sighted],
    behind: Sequence[Behind],
    been: Floats,
    scene: Scene,
) -> tuple[float, float]:
    """The mean position of the posterior on a finer grid about a pose."""
    at = np.array([(x + dx, y + dy) for dx in _FINE for dy in _FINE])
    which = np.repeat(np.arange(len(at)), len(_FINE_YAW))
    poses = np.column_stack((at[which], np.tile(yaw + _FINE_YAW, len(at))))
    error = _FINE_M * _FINE_M / 12.0
    terms = [
        [terms_at(crop, at, error + back.m2, scene) for crop in view.crops]
        if back.away_m < _SAME_SPOT_M
        else []
        for view, back in zip(sighted, behind, strict=True)
    ]
    score = log_prior(at, been, scene.model, scene.walls)[which]
    for one in _crop_likelihoods(poses, which, sighted, behind, terms, error, scene):
        score = score + one
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    return float((poses[:, 0] * weights).sum()), float((poses[:, 1] * weights).sum())


def _mean_yaw(yaws: Floats, weights: Floats) -> float | None:
    """The circular mean in (-π, π], None when the yaws disagree."""
    sin, cos = float((np.sin(yaws) * weights).sum()), float((np.cos(yaws) * weights).sum())
    return math.atan2(sin, cos) if math.hypot(sin, cos) >= _MIN_YAW_AGREEMENT else None
