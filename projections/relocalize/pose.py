"""Poses: weigh where the robot may be, at the last view of a question, and choose.

The posterior is a grid of cells of 0.35 m near positions from which a landmark was seen, times
headings. Of all cells within 1.2 m those are kept that fit best whatever the heading, by cells of
0.7 m first. In each, the headings are those that put one of the likeliest landmarks of a crop where
the crop shows it: nodes of an integral over all headings, each weighing its likelihood divided by
how densely they lie. A pose's likelihood is the product over crops of their mixtures
(`likelihood`); the prior is that robots drive where robots have driven.

Several views: the robot's movement between them is known but for a small error that grows with it,
so each pose at the last view gives a pose at every view before.

The answer is the cell with the least expected error, errors above 3 m counting as 3 m (like a
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
from .landmarks import CropEvidence, crop_evidence, likeness_of
from .likelihood import (
    Scene,
    Terms,
    headings,
    log_likelihood,
    log_likelihood_of_place,
    terms_at,
)
from .question import View
from .sessions import session_shifts

Indices = NDArray[np.intp]
_TermsOfViews = Sequence[Sequence[Terms]]

CELL_M: Final = 0.35
_COARSE_KEPT: Final = 60
_KEPT: Final = 150
_HEADINGS: Final = 8
_TURN: Final = 2.0 * math.pi
_HEADING_FLOOR: Final = 0.05 / _TURN
_FINE_M: Final = 0.12
_FINE: Final = np.arange(-3, 4) * _FINE_M
_FINE_YAW: Final = np.array([-0.16, -0.08, 0.0, 0.08, 0.16])
_MAX_ERROR_M: Final = 3.0
_NEAR_M: Final = 1.0
_MIN_YAW_AGREEMENT: Final = 0.8
_LEAST_PRIOR: Final = 1e-9
_SAME_SPOT_M: Final = 0.05
_LEAST_WEIGHT: Final = 1e-12

STEP_M, STEP_PART = 0.02, 0.05
TURN_RAD, TURN_PART = 0.01, 0.05
"""Standard error of a movement between two views: of its length, and of its turn."""


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
    dx: float
    dy: float
    dyaw: float


@dataclass(frozen=True, slots=True)
class _Behind:
    """How sure the pose at a view is, given that at the last one, and how far it lies from it."""

    m2: float
    yaw2: float
    away_m: float
    turn: float


def locate(
    views: Sequence[View], matches: Sequence[Sequence[Match]], scene: Scene
) -> Posterior | None:
    """The posterior over poses at the last view; ``matches`` run parallel to the crops of all
    views. None if no match has a pose."""
    sighted = _sighted(views, matches, scene)
    crops = [crop for view in sighted for crop in view.crops]
    if not crops:
        return None
    behind = _behind(sighted)
    been = _distinct(np.concatenate([crop.landmarks.seen_from for crop in crops]), CELL_M / 2)
    coarse = _cells_near(been, 2.0 * CELL_M, scene.model.reach_m)
    score, _ = _score_places(coarse, sighted, behind, been, 2.0 * CELL_M, scene)
    kept = _best(score, _COARSE_KEPT)
    quarter = CELL_M / 2
    corners = np.array([(x, y) for x in (-quarter, quarter) for y in (-quarter, quarter)])
    cells = (coarse[kept][:, None] + corners[None]).reshape(-1, 2)
    score, terms = _score_places(cells, sighted, behind, been, CELL_M, scene)
    kept = _best(score, _KEPT)
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
        found.append(_Sighted(present, view.dx, view.dy, view.dyaw))
    return found


def _behind(sighted: Sequence[_Sighted]) -> list[_Behind]:
    """Of each view, what lies between it and the last one."""
    m2 = yaw2 = turn = 0.0
    x = y = 0.0
    found = [_Behind(0.0, 0.0, 0.0, 0.0)]
    for view in reversed(sighted[1:]):
        length = math.hypot(view.dx, view.dy)
        yaw2 += TURN_RAD**2 + (TURN_PART * view.dyaw) ** 2
        m2 += STEP_M**2 + (STEP_PART * length) ** 2 + yaw2 * length * length
        turn += view.dyaw
        cos, sin = math.cos(-turn), math.sin(-turn)
        x, y = x - (cos * view.dx - sin * view.dy), y - (sin * view.dx + cos * view.dy)
        found.append(_Behind(m2, yaw2, math.hypot(x, y), turn))
    return found[::-1]


def poses_at_views(poses: Floats, movements: Sequence[tuple[float, float, float]]) -> list[Floats]:
    """Poses (h, 3) at every view from those at the last one; ``movements`` as in `View`."""
    found = [poses]
    for dx, dy, dyaw in reversed(movements[1:]):
        x, y, yaw = found[-1].T
        yaw = yaw - dyaw
        cos, sin = np.cos(yaw), np.sin(yaw)
        found.append(np.column_stack((x - (cos * dx - sin * dy), y - (sin * dx + cos * dy), yaw)))
    return found[::-1]


def _distinct(points: Floats, grid_m: float) -> Floats:
    """The points, those in one square of a grid once."""
    return _unique(np.rint(points / grid_m)) * grid_m


def _unique(cells: Floats) -> Floats:
    """Each pair of whole numbers once, in order."""
    pairs = np.unique(np.ascontiguousarray(cells).view(np.complex128))
    return np.column_stack((pairs.real, pairs.imag))


def _cells_near(points: Floats, cell_m: float, reach_m: float) -> Floats:
    """Middles of the cells of a grid within reach of a point."""
    most = math.ceil(reach_m / cell_m)
    steps = np.array(
        [
            (x, y)
            for x in range(-most, most + 1)
            for y in range(-most, most + 1)
            if math.hypot(x, y) * cell_m <= reach_m + cell_m / 2
        ],
        dtype=np.float64,
    )
    cells = np.rint(points / cell_m)
    return _unique((cells[:, None] + steps[None]).reshape(-1, 2)) * cell_m


def _log_prior(xy: Floats, been: Floats, scene: Scene) -> Floats:
    """How likely a robot is there: by the distance from where robots have been."""
    model = scene.model
    dx = xy[:, 0, None] - been[None, :, 0]
    dy = xy[:, 1, None] - been[None, :, 1]
    squared = -0.5 * (dx * dx + dy * dy).min(1)
    near = model.driven_share * np.exp(squared / model.driven_m**2)
    far = (1.0 - model.driven_share) * np.exp(squared / model.driven_far_m**2)
    found: Floats = np.log(near + far + _LEAST_PRIOR)
    return found


def _score_places(
    xy: Floats,
    sighted: Sequence[_Sighted],
    behind: Sequence[_Behind],
    been: Floats,
    cell_m: float,
    scene: Scene,
) -> tuple[Floats, _TermsOfViews]:
    """The log-likelihood of cells whatever the heading, and the terms there. A view from elsewhere
    counts as one from here with a larger error."""
    total = _log_prior(xy, been, scene)
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
    behind: Sequence[_Behind],
    been: Floats,
    asked: int,
    scene: Scene,
) -> Posterior:
    prior = _log_prior(cells, been, scene)
    error = CELL_M * CELL_M / 12.0
    which, yaw, density = _hypotheses(sighted, behind, terms, scene)
    poses = np.column_stack((cells[which], yaw))
    each = np.stack(list(_crop_likelihoods(poses, which, sighted, behind, terms, error, scene)))
    score = each.sum(0) + prior[which] - density
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    return _choose(cells, poses, which, weights, each, sighted, behind, been, asked, scene)


def _hypotheses(
    sighted: Sequence[_Sighted],
    behind: Sequence[_Behind],
    terms: _TermsOfViews,
    scene: Scene,
) -> tuple[Indices, Floats, Floats]:
    """Headings at the cells: the cell's index, the heading at the last view, and the logarithm of
    how densely the headings of that cell lie there."""
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
    density = (bells / np.sqrt(_TURN * variance)[None]).mean(1) + _HEADING_FLOOR
    which = np.tile(np.arange(yaw.shape[1]), len(yaw))
    return which, yaw.ravel(), np.log(density).ravel()


def _crop_likelihoods(
    poses: Floats,
    which: Indices,
    sighted: Sequence[_Sighted],
    behind: Sequence[_Behind],
    terms: _TermsOfViews,
    error: float,
    scene: Scene,
) -> Iterator[Floats]:
    """The log-likelihood of each crop at poses of the last view. ``terms`` at the positions that
    ``which`` names serve the views from the same spot."""
    movements = [(view.dx, view.dy, view.dyaw) for view in sighted]
    at_views = poses_at_views(poses, movements)
    for number, (view, back, here) in enumerate(zip(sighted, behind, at_views, strict=True)):
        for index, crop in enumerate(view.crops):
            if back.away_m < _SAME_SPOT_M:
                there = terms[number][index].take(which)
            else:
                there = terms_at(crop, here[:, :2], error + back.m2, scene)
            yield log_likelihood(crop, there, here[:, 2], back.yaw2, scene)


def _choose(
    cells: Floats,
    poses: Floats,
    which: Indices,
    weights: Floats,
    each: Floats,
    sighted: Sequence[_Sighted],
    behind: Sequence[_Behind],
    been: Floats,
    asked: int,
    scene: Scene,
) -> Posterior:
    of_cell: Floats = weights.reshape(-1, len(cells)).sum(0)
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
        [crop.landmarks for crop in crops],
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
    behind: Sequence[_Behind],
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
    score = _log_prior(at, been, scene)[which]
    for one in _crop_likelihoods(poses, which, sighted, behind, terms, error, scene):
        score = score + one
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    return float((poses[:, 0] * weights).sum()), float((poses[:, 1] * weights).sum())


def _mean_yaw(yaws: Floats, weights: Floats) -> float | None:
    """The circular mean in (-π, π], None when the yaws disagree."""
    sin, cos = float((np.sin(yaws) * weights).sum()), float((np.cos(yaws) * weights).sum())
    return math.atan2(sin, cos) if math.hypot(sin, cos) >= _MIN_YAW_AGREEMENT else None
