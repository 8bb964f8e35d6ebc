"""How well the things of two maps agree under a transform: pairs by looks and distance, matched one
to one, and the transform refined from the pairs.

A transform (x, y, θ) maps the second map's frame into the first one's. A pair's value is the
log-likelihood ratio that both are one thing, against one that stands there by chance: by looks at
the change of side under θ, by label, and by the distance of the two positions under their
covariances against the density of things. The *score* of a transform is the sum of the values of
the best matching.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from projections.fold.evidence import EvidenceConstants
from projections.fold.looks import LookRatios

from .framed_things import FramedThings

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Transform = tuple[float, float, float]

TURNS: Final = 16
"""The number of angles between the two frames at which looks are compared."""
SLACK_M: Final = 0.2
"""Standard error of the distance of one thing's two positions beside their covariances: drift, and
the middle of a box is not that of the thing."""
_GATE: Final = 11.8
"""χ² of two degrees of freedom that a pair exceeds once in 370 times."""
_REACH_M: Final = 3.0
_MOST_LOOKS: Final = 3.0
"""The most independent looks that a pair of things has."""
_MOST_RATIO: Final = 6.0
_LABEL_WEIGHT: Final = 0.5
_SAME_LABEL: Final = 0.85
"""The probability that one thing has the same label in both maps."""
_CAUCHY: Final = 4.0
"""The χ² at which a pair counts half."""
_ROUNDS: Final = 6
_STEPS: Final = 6
_SEEN_M: Final = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPairs:
    """The pairs of a transform: indices of things of the first and second map, and their values."""

    transform: Transform
    firsts: Indices
    seconds: Indices
    values: Floats

    @property
    def score(self) -> float:
        """The sum of the values."""
        return float(self.values.sum())

    def __len__(self) -> int:
        return len(self.values)

    def pairs(self) -> set[tuple[int, int]]:
        """The pairs as indices."""
        return set(zip(self.firsts.tolist(), self.seconds.tolist(), strict=True))


def moved(xy: Floats, transform: Transform) -> Floats:
    """Points (n, 2) of the second frame in the first one."""
    x, y, angle = transform
    turned: Floats = xy @ rotation(angle).T + (x, y)
    return turned


def rotation(angle: float) -> Floats:
    """The matrix that turns by an angle, radians."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array(((cos, -sin), (sin, cos)))


class Comparison:
    """Two maps' things, with the ratios of all pairs by looks and label."""

    def __init__(self, first: FramedThings, second: FramedThings) -> None:
        self.first, self.second = first, second
        self._tree, self._looked_at = cKDTree(first.xy), cKDTree(first.looked_at)
        self.ratios = _look_ratios(first, second) + _label_ratios(first, second)
        """(`TURNS`, n, m): under a turn by 2π t / `TURNS`."""

    def ratios_at(self, angle: float, firsts: Indices, seconds: Indices) -> Floats:
        """The ratios of pairs under a turn, interpolated."""
        turn, share = divmod((angle % math.tau) / math.tau * TURNS, 1.0)
        below, above = int(turn) % TURNS, (int(turn) + 1) % TURNS
        one = self.ratios[below, firsts, seconds]
        found: Floats = (1.0 - share) * one + share * self.ratios[above, firsts, seconds]
        return found

    def matching(self, transform: Transform, slack_m: float = SLACK_M) -> MatchedPairs:
        """The best matching under a transform."""
        there = moved(self.second.xy, transform)
        near = self._tree.query_ball_point(there, _REACH_M)
        counts = [len(row) for row in near]
        firsts = np.concatenate([np.array(row, np.intp) for row in near])
        seconds = np.repeat(np.arange(len(there)), counts)
        apart = self.first.xy[firsts] - there[seconds]
        spread = self._spread(transform, firsts, seconds, slack_m)
        chi2 = _chi2(apart, spread)
        chance = 2.0 * math.pi * np.sqrt(np.linalg.det(spread)) * self.first.density
        values = self.ratios_at(transform[2], firsts, seconds) - 0.5 * chi2 - np.log(chance)
        good = (chi2 < _GATE) & (values > 0.0)
        return _best_matching(transform, firsts[good], seconds[good], values[good])

    def refined(self, transform: Transform) -> MatchedPairs:
        """The best matching near a transform, found by matching and least squares in turn, with a
        slack that shrinks."""
        best: MatchedPairs | None = None
        slack = 2.5 * SLACK_M
        for _ in range(_ROUNDS):
            found = self.matching(transform, max(slack, SLACK_M))
            slack *= 0.6
            if slack < 1.7 * SLACK_M and (best is None or found.score > best.score):
                best = found
            if len(found) < 2:
                break
            transform = self._fitted(found, transform)
        last = self.matching(transform)
        return last if best is None or last.score >= best.score else best

    def is_expected(self, transform: Transform) -> NDArray[np.bool_]:
        """Which things of the second map the first robot should have seen under a transform: it
        looked at where they stand, and they were seen twice or more."""
        there = moved(self.second.xy, transform)
        was_looked_at = self._looked_at.query(there)[0] < _SEEN_M
        found: NDArray[np.bool_] = was_looked_at & (self.second.seen >= 2)
        return found

    def information(self, found: MatchedPairs) -> Floats:
        """The inverse covariance (3, 3) of a matching's transform."""
        return self._normal(found, found.transform)[0]

    def _fitted(self, found: MatchedPairs, transform: Transform) -> Transform:
        """The transform by robust least squares over the pairs of a matching."""
        at = np.array(transform)
        for _ in range(_STEPS):
            information, gradient = self._normal(found, (at[0], at[1], at[2]))
            step = np.linalg.solve(information, gradient)
            at += step
            if np.abs(step).max() < 1e-5:
                break
        return float(at[0]), float(at[1]), math.remainder(float(at[2]), math.tau)

    def _normal(self, found: MatchedPairs, transform: Transform) -> tuple[Floats, Floats]:
        """The matrix and the right side of the normal equations, by Cauchy weights."""
        i, j = found.firsts, found.seconds
        turned = self.second.xy[j] @ rotation(transform[2]).T
        apart = self.first.xy[i] - turned - transform[:2]
        weights = np.linalg.inv(self._spread(transform, i, j, SLACK_M))
        chi2 = np.einsum("ni,nij,nj->n", apart, weights, apart)
        weights /= (1.0 + chi2 / _CAUCHY)[:, None, None]
        slopes = jacobians(turned)
        information = np.einsum("nki,nkl,nlj->ij", slopes, weights, slopes) + 1e-9 * np.eye(3)
        return information, np.einsum("nki,nkl,nl->i", slopes, weights, apart)

    def _spread(
        self, transform: Transform, firsts: Indices, seconds: Indices, slack_m: float
    ) -> Floats:
        """The covariances (k, 2, 2) of the distances of pairs."""
        turn = rotation(transform[2])
        turned = turn @ self.second.covariance[seconds] @ turn.T
        spread: Floats = self.first.covariance[firsts] + turned + slack_m**2 * np.eye(2)
        return spread


def jacobians(turned: Floats) -> Floats:
    """By x, y and θ, (n, 2, 3), of points that are turned but not moved."""
    slopes = np.zeros((len(turned), 2, 3))
    slopes[:, 0, 0] = slopes[:, 1, 1] = 1.0
    slopes[:, 0, 2], slopes[:, 1, 2] = -turned[:, 1], turned[:, 0]
    return slopes


def _chi2(apart: Floats, spread: Floats) -> Floats:
    found: Floats = np.einsum("ni,nij,nj->n", apart, np.linalg.inv(spread), apart)
    return found


def _best_matching(
    transform: Transform, firsts: Indices, seconds: Indices, values: Floats
) -> MatchedPairs:
    """The matching of the largest sum among pairs of positive values, by connected parts."""
    if not len(values):
        return MatchedPairs(transform, firsts, seconds, values)
    rows, row = np.unique(firsts, return_inverse=True)
    columns, column = np.unique(seconds, return_inverse=True)
    size = len(rows) + len(columns)
    graph = coo_array((np.ones(len(values)), (row, len(rows) + column)), shape=(size, size))
    part = connected_components(graph, directed=False)[1][row]
    order = np.argsort(part, kind="stable")
    chosen: list[NDArray[np.intp]] = []
    for of_part in np.split(order, np.flatnonzero(np.diff(part[order])) + 1):
        if len(of_part) == 1:
            chosen.append(of_part)
            continue
        up, a = np.unique(row[of_part], return_inverse=True)
        left, b = np.unique(column[of_part], return_inverse=True)
        table = np.zeros((len(up), len(left)))
        index = np.full(table.shape, -1)
        table[a, b], index[a, b] = values[of_part], of_part
        picked = index[linear_sum_assignment(table, maximize=True)]
        chosen.append(picked[picked >= 0])
    at = np.sort(np.concatenate(chosen))
    return MatchedPairs(transform, firsts[at], seconds[at], values[at])


def _look_ratios(first: FramedThings, second: FramedThings) -> Floats:
    different = (first.different + second.different) / 2.0
    cosines = first.looks @ second.looks.T
    likeness = np.maximum((cosines - different) / (1.0 - different), 0.0)
    agree = first.classes[first.owners][:, None] == second.classes[second.owners][None]
    apart = first.sides[:, None] - second.sides[None]
    cos, sin = np.cos(apart), np.sin(apart)
    counts = [np.bincount(each.owners) for each in (first, second)]
    number = counts[0][:, None] * counts[1][None]
    weights = np.minimum(np.sqrt(number), _MOST_LOOKS) / number
    begins = [np.cumsum(count) - count for count in counts]
    table, other_run = LookRatios(EvidenceConstants()), np.ones((1, 1), np.bool_)
    found = np.empty((TURNS, len(first.xy), len(second.xy)))
    for turn in range(TURNS):
        angle = math.tau * turn / TURNS
        sides = cos * math.cos(angle) + sin * math.sin(angle)
        ratios = table.ratios(likeness, sides, other_run, agree)
        ratios = np.minimum(np.maximum(ratios, -_MOST_RATIO), _MOST_RATIO)
        sums = np.add.reduceat(np.add.reduceat(ratios, begins[0], 0), begins[1], 1)
        found[turn] = sums * weights
    return found


def _label_ratios(first: FramedThings, second: FramedThings) -> Floats:
    """(n, m): an agreement on a rare label counts more."""
    labels, counts = np.unique(np.concatenate((first.classes, second.classes)), return_counts=True)
    shares = counts[np.searchsorted(labels, first.classes)] / counts.sum()
    agree = first.classes[:, None] == second.classes[None]
    found: Floats = _LABEL_WEIGHT * np.where(
        agree, np.log(_SAME_LABEL / shares)[:, None], math.log(1.0 - _SAME_LABEL)
    )
    return found
