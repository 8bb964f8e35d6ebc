"""Poses: weigh the robot's possible poses at the last view of a question, and choose one.

The posterior is a grid of cells of 0.35 m near positions from which a landmark was seen, times
headings. Of all cells within 1.6 m those are kept that fit best whatever the heading, by cells of
0.7 m first. In each, the headings are those that put one of the likeliest landmarks of a crop where
the crop shows it: nodes of an integral over all headings, each weighing its likelihood divided by
how densely they lie. What holds for every heading is taken off at the nodes, and added once. A
pose's likelihood is the product over crops of their mixtures (`likelihood`); the prior is that
robots drive where robots have driven (`ground`).

Several views: each pose at the last view gives a pose at every view before (`poses_at_views`).

The answer is the cell with the least expected error, moved to the mean of the weights near it,
which is then computed again on a grid of 0.12 m. In that expectation errors above 4 m counting as 4
m (like a median; a mean could lie between two look-alike spots). A fifth of that expectation is
over the positions of robots at the ten observations most similar to each crop. This fifth decides
where the weights are spread over half the building, as with one crop of a thing that the map has
many of, and hardly matters elsewhere.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .appearance import session_shifts, usual_likeness
from .camera import Floats
from .candidates import Match
from .certainty import Features, confidence_of, features_of
from .ground import cells_near, distinct, log_prior, square_to_nearest
from .landmarks import CropGroup, Landmarks, Seen, crop_groups, likeness_of
from .likelihood import (
    Scene,
    Terms,
    headings,
    log_likelihood,
    log_likelihood_of_place,
    log_likelihood_unaimed,
    terms_at,
)
from .question import Behind, Movement, QuestionView, behind_last, poses_at_views

Indices = NDArray[np.intp]
_TermsOfViews = Sequence[Sequence[Terms]]

CELL_M: Final = 0.35
_COARSE_KEPT, _COARSE_IN_ALL = 40, 96
_KEPT, _IN_ALL = 100, 240
"""Cells that are kept; with few crops, which leave more poses open, so many for all crops
together."""
_HEADINGS: Final = 8
_TURN: Final = 2.0 * math.pi
_FINE_M: Final = 0.12
_FINE: Final = np.arange(-3, 4) * _FINE_M
_FINE_SQUARE: Final = np.array([(dx, dy) for dx in _FINE for dy in _FINE])
_QUARTERS: Final = np.array([(x, y) for x in (-1, 1) for y in (-1, 1)]) * (CELL_M / 2)
_FINE_YAW: Final = np.array([-0.16, -0.08, 0.0, 0.08, 0.16])
_MAX_LOSS_M: Final = 2.5
"""The most that an error counts in the feature ``loss`` of the confidence, in metres."""
_NEAR_M: Final = 1.0
_MIN_YAW_AGREEMENT: Final = 0.8
_SAME_SPOT_M: Final = 0.05
_LEAST_WEIGHT: Final = 1e-12
_LANDMARKS, _LEAST_LANDMARKS = 48, 3
_MOST_SPOTS: Final = 600
MAX_ERROR_M: Final = 4.0
PLAIN_SHARE: Final = 0.2
PLAIN_NEAREST: Final = 10


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
    """The crops of a view that have evidence, those with a box and those without, the movement
    since the view before, and the error of its pose given that at the last view."""

    groups: tuple[CropGroup, ...]
    movement: Movement
    behind: Behind


@dataclass(frozen=True, slots=True, eq=False)
class _Asked:
    """A question: its views, the landmarks of each crop, positions from which those were seen
    (``been``) and from which the most similar observations were made (``stood``), and the number
    of its crops."""

    views: Sequence[_Sighted]
    marks: Sequence[Landmarks]
    been: Floats
    stood: Floats
    crops: int
    scene: Scene

    def prior(self, xy: Floats) -> Floats:
        """The log prior of positions."""
        model, walls = self.scene.model, self.scene.walls
        return log_prior(xy, square_to_nearest(xy, self.been), model, walls)


def locate(
    views: Sequence[QuestionView], matches: Sequence[Sequence[Match]], scene: Scene
) -> Posterior | None:
    """The posterior over poses at the last view; ``matches`` run parallel to the crops of all
    views. None if no match has a pose."""
    sighted = _sighted(views, matches, scene)
    marks = [each for view in sighted for group in view.groups for each in group.of_each()]
    if not marks:
        return None
    been = likely_spots(marks, CELL_M / 2)
    asked = _Asked(sighted, marks, been, stood_at(views, matches), len(matches), scene)
    coarse, apart = cells_near(been, 2.0 * CELL_M, scene.model.reach_m)
    prior = log_prior(coarse, apart, scene.model, scene.walls)
    score = prior + _score_of_places(asked, _terms_at(asked, coarse, 2.0 * CELL_M))
    kept = _best(score, max(_COARSE_KEPT, _COARSE_IN_ALL // len(marks)))
    cells = (coarse[kept][:, None] + _QUARTERS).reshape(-1, 2)
    prior = asked.prior(cells)
    terms = _terms_at(asked, cells, CELL_M, every=True)
    kept = _best(prior + _score_of_places(asked, terms), max(_KEPT, _IN_ALL // len(marks)))
    terms = [[each.take(kept) for each in of_view] for of_view in terms]
    return _weigh(asked, cells[kept], prior[kept], terms)


def likely_spots(marks: Sequence[Landmarks], grid_m: float) -> Floats:
    """Positions from which a landmark was seen, one for each square of a grid, at most
    `_MOST_SPOTS`. With many crops, only the landmarks that look most like each crop are used, which
    bounds the cost of a question with many views."""
    most = max(_LEAST_LANDMARKS, _LANDMARKS // len(marks))
    found = []
    for each in marks:
        looks = each.ratios.max(1)
        chosen = np.argsort(-looks, kind="stable")
        ends = np.append(each.starts[1:], len(each.seen_from))
        for rank, landmark in enumerate(chosen.tolist()):
            if rank < most or looks[landmark] == looks[chosen[0]]:
                found.append(each.seen_from[each.starts[landmark] : ends[landmark]])
    spots = distinct(np.concatenate(found), grid_m)
    return spots[:: -(-len(spots) // _MOST_SPOTS)]


def _sighted(
    views: Sequence[QuestionView], matches: Sequence[Sequence[Match]], scene: Scene
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
    seen = []
    for view in views:
        of_view = [
            Seen.of(crop, row, alike, {} if crop.vector is None or crop.is_text else shifts)
            for crop, row, alike in itertools.islice(rows, len(view.crops))
        ]
        seen.append([each for each in of_view if each is not None])
    if not any(seen):
        return []
    groups = crop_groups(seen, constants, scene.camera, scene.model)
    movements = [(view.dx, view.dy, view.dyaw) for view in views]
    return [
        _Sighted(tuple(of_view), movement, behind)
        for of_view, movement, behind in zip(groups, movements, behind_last(movements), strict=True)
    ]


def _terms_at(asked: _Asked, xy: Floats, cell_m: float, *, every: bool = False) -> _TermsOfViews:
    """The terms at cells. A view from another pose is treated as one from this pose with a larger
    error."""
    found = []
    for view in asked.views:
        error = cell_m * cell_m / 12.0 + view.behind.m2 + 0.5 * view.behind.away_m**2
        found.append([terms_at(each, xy, error, asked.scene, every=every) for each in view.groups])
    return found


def _score_of_places(asked: _Asked, terms: _TermsOfViews) -> Floats:
    """The log-likelihood at the terms' positions whatever the heading."""
    scores = [
        log_likelihood_of_place(group, each, asked.scene).sum(0)
        for view, of_view in zip(asked.views, terms, strict=True)
        for group, each in zip(view.groups, of_view, strict=True)
    ]
    total: Floats = np.sum(scores, axis=0)
    return total


def _best(score: Floats, count: int) -> Indices:
    return np.argsort(-score, kind="stable")[:count]


def _weigh(asked: _Asked, cells: Floats, prior: Floats, terms: _TermsOfViews) -> Posterior:
    yaw, density = _hypotheses(asked, terms)
    terms = [[each.relevant() for each in of_view] for of_view in terms]
    poses = np.empty((yaw.size, 3))
    poses[:, :2] = np.tile(cells, (len(yaw), 1))
    poses[:, 2] = yaw.ravel()
    each = _crop_likelihoods(asked, poses, terms, CELL_M * CELL_M / 12.0)
    anywhere = prior.copy()
    for of_view in terms:
        for there in of_view:
            anywhere += log_likelihood_unaimed(there, asked.scene).sum(0)
    score = each.sum(0).reshape(yaw.shape) + prior
    most = max(float(score.max()), float(anywhere.max()))
    rest = np.exp(anywhere - most)
    weights = np.maximum(np.exp(score - most) - rest, 0.0) / density
    of_cell = weights.sum(0) + _TURN * len(yaw) * rest
    weights, of_cell = weights / of_cell.sum(), of_cell / of_cell.sum()
    return _choose(asked, cells, of_cell, poses, weights, each)


def _hypotheses(asked: _Asked, terms: _TermsOfViews) -> tuple[Floats, Floats]:
    """Headings (k, h) of the last view at the cells, and the density of a cell's headings there."""
    found = []
    for view, of_view in zip(asked.views, terms, strict=True):
        for each in of_view:
            yaw, variance, weight = headings(each)
            found.append((yaw + view.behind.turn, variance + view.behind.yaw2, weight))
    yaws, variances, weights = (
        part[0] if len(part) == 1 else np.concatenate(part) for part in zip(*found, strict=True)
    )
    chosen = np.argsort(-weights, axis=0, kind="stable")[:_HEADINGS]
    chosen = chosen * yaws.shape[1] + np.arange(yaws.shape[1])
    yaw, variance = yaws.take(chosen), variances.take(chosen)
    off = yaw[:, None] - yaw[None]
    off -= _TURN * np.rint(off / _TURN)
    bells = np.exp(-0.5 * np.minimum(off * off / variance[None], 40.0))
    return yaw, (bells / np.sqrt(_TURN * variance)[None]).mean(1)


def _crop_likelihoods(asked: _Asked, poses: Floats, terms: _TermsOfViews, error: float) -> Floats:
    """The log-likelihood of each crop at poses of the last view, shape (c, k · h): k times the h
    positions of ``terms``, which serve the views from the same spot."""
    found = []
    at_views = poses_at_views(poses, [view.movement for view in asked.views])
    for view, here, of_view in zip(asked.views, at_views, terms, strict=True):
        for index, group in enumerate(view.groups):
            if view.behind.away_m < _SAME_SPOT_M:
                there = of_view[index]
            else:
                there = terms_at(group, here[:, :2], error + view.behind.m2, asked.scene)
            yaw = here[:, 2].reshape(-1, there.positions)
            likelihood = log_likelihood(group, there, yaw, view.behind.yaw2, asked.scene)
            found.append(likelihood.reshape(-1, len(poses)))
    return found[0] if len(found) == 1 else np.concatenate(found)


def _choose(
    asked: _Asked, cells: Floats, of_cell: Floats, poses: Floats, weights: Floats, each: Floats
) -> Posterior:
    """The answer, from weights of the cells and of their ``poses``, and the log-likelihood of each
    crop at these."""
    dx, dy = (cells - cells[least_error(cells, of_cell, asked.stood)]).T
    apart = np.sqrt(dx * dx + dy * dy)
    near = np.maximum(of_cell, _LEAST_WEIGHT) * (apart < _NEAR_M)
    x, y = (float((cells[:, axis] * near).sum() / near.sum()) for axis in (0, 1))
    close = (np.maximum(weights, _LEAST_WEIGHT) * near.astype(np.bool_)).ravel()
    yaw = _mean_yaw(poses[:, 2], close / close.sum())
    x, y = _refine(asked, x, y, float(poses[int(np.argmax(close)), 2]))
    squared = (cells[:, 0] - x) ** 2 + (cells[:, 1] - y) ** 2
    groups = (group for view in asked.views for group in view.groups)
    embedded = [flag for group in groups for flag in group.has_embedding]
    found = features_of(
        list(itertools.compress(asked.marks, embedded)),
        each[:, int(np.argmax(weights))],
        asked.crops,
        float(of_cell[squared < 1.5**2].sum()),
        float((np.minimum(np.sqrt(squared), _MAX_LOSS_M) * of_cell).sum()),
        asked.scene.model,
    )
    order = np.argsort(-of_cell, kind="stable")
    heaviest = weights.argmax(0) * len(cells) + np.arange(len(cells))
    return Posterior(
        poses[heaviest[order]],
        of_cell[order],
        x,
        y,
        yaw,
        math.sqrt(float((squared * of_cell).sum())),
        found,
        confidence_of(found, asked.scene.constants.localizer),
    )


def _refine(asked: _Asked, x: float, y: float, yaw: float) -> tuple[float, float]:
    """The mean position of the posterior on a finer grid about a pose."""
    at = _FINE_SQUARE + np.array((x, y))
    poses = np.empty((len(_FINE_YAW) * len(at), 3))
    poses[:, :2] = np.tile(at, (len(_FINE_YAW), 1))
    poses[:, 2] = (yaw + _FINE_YAW).repeat(len(at))
    error = _FINE_M * _FINE_M / 12.0
    terms = [
        [terms_at(group, at, error + view.behind.m2, asked.scene) for group in view.groups]
        if view.behind.away_m < _SAME_SPOT_M
        else []
        for view in asked.views
    ]
    score = _crop_likelihoods(asked, poses, terms, error).sum(0)
    score += np.tile(asked.prior(at), len(_FINE_YAW))
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    return float((poses[:, 0] * weights).sum()), float((poses[:, 1] * weights).sum())


def _mean_yaw(yaws: Floats, weights: Floats) -> float | None:
    """The circular mean in (-π, π], None when the yaws disagree."""
    sin, cos = float((np.sin(yaws) * weights).sum()), float((np.cos(yaws) * weights).sum())
    return math.atan2(sin, cos) if math.hypot(sin, cos) >= _MIN_YAW_AGREEMENT else None


def stood_at(views: Sequence[QuestionView], matches: Sequence[Sequence[Match]]) -> Floats:
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
