"""How well the things of two maps agree under a transform: pairs by looks and distance, matched one
to one, and the transform refined from the pairs.

A transform (x, y, θ) maps the second map's frame into the first one's. A pair's value is the
log-likelihood ratio that both are one thing, against one that stands there by chance: by looks at
the change of side under θ, by label, and by the distance of the two positions under their
covariances against the density of things. The *score* of a transform is the sum of the values of
the best matching.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, maximum_flow
from scipy.spatial import cKDTree

from projections.fold.evidence import EvidenceConstants
from projections.fold.looks import LookRatios

from .framed_things import EXEMPLARS, FramedThings

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Transform = tuple[float, float, float]

TURNS: Final = 16
"""The number of angles between the two frames at which looks are compared."""
_TURNS: Final = [math.tau * turn / TURNS for turn in range(TURNS)]
_LOOKED_INTO: Final = 4
"""So many times more pairs than are asked for are compared look by look."""
_MOST_COMPARED: Final = 10_000
"""The most looks of a map that are compared, unless it has more things."""
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
_OTHER_LABEL: Final = _LABEL_WEIGHT * math.log(1.0 - _SAME_LABEL)
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


class Tie(NamedTuple):
    """Where a pose of the second map lies in the first one's frame, beside the things: near ``to``,
    poses (3,) in m and radians, with a standard error in m and one in radians."""

    pose: Floats
    to: Floats
    error_m: float
    error_rad: float

    @property
    def transform(self) -> Transform:
        """That which brings the pose there."""
        angle = math.remainder(float(self.to[2] - self.pose[2]), math.tau)
        x, y = (self.to[:2] - rotation(angle) @ self.pose[:2]).tolist()
        return x, y, angle

    def apart(self, transform: Transform) -> tuple[float, float]:
        """How far from there a transform brings the pose, and by which angle it is off."""
        ((x, y),) = moved(self.pose[None, :2], transform).tolist()
        off = math.remainder(float(self.to[2] - self.pose[2]) - transform[2], math.tau)
        return math.hypot(x - self.to[0], y - self.to[1]), off


class _Looks(NamedTuple):
    """The looks of n things that are compared, and from which ``sides`` they are; ``rows`` (n, k)
    are those of each, of which it has ``counts`` (n,), the rest -1."""

    looks: NDArray[np.float32]
    sides: Floats
    rows: Indices
    counts: Indices

    @classmethod
    def of(cls, things: FramedThings) -> Self:
        """Fewer of each thing where a map has very many."""
        most = max(1, min(EXEMPLARS, _MOST_COMPARED // len(things.xy)))
        every = np.bincount(things.owners)
        counts = np.minimum(every, most)
        at = np.arange(most)
        steps = np.rint(at * ((every - 1) / np.maximum(counts - 1, 1))[:, None]).astype(np.intp)
        is_there = at < counts[:, None]
        chosen = (steps + (np.cumsum(every) - every)[:, None])[is_there]
        rows = np.full(is_there.shape, -1)
        rows[is_there] = np.arange(len(chosen))
        return cls(things.looks[chosen].astype(np.float32), things.sides[chosen], rows, counts)


class Comparison:
    """Two maps' things, with the likeness of all pairs of their looks."""

    def __init__(self, first: FramedThings, second: FramedThings, tie: Tie | None = None) -> None:
        self.first, self.second, self.tie = first, second, tie
        self._tree, self._looked_at = cKDTree(first.xy), cKDTree(first.looked_at)
        self._table, self._other_run = LookRatios(EvidenceConstants()), np.ones((1, 1), np.bool_)
        self._looks = _Looks.of(first), _Looks.of(second)
        different = (first.different + second.different) / 2.0
        cosines = self._looks[0].looks @ self._looks[1].looks.T
        cosines -= np.float32(different)
        cosines /= np.float32(1.0 - different)
        self._likeness = np.maximum(cosines, np.float32(0.0), out=cosines)
        both = np.concatenate((first.classes, second.classes))
        _, labels, counts = np.unique(both, return_inverse=True, return_counts=True)
        self._labels = labels[: len(first.xy)], labels[len(first.xy) :]
        shares = counts[self._labels[0]] / counts.sum()
        self._agreement = _LABEL_WEIGHT * np.log(_SAME_LABEL / shares)

    def ratios_at(self, angle: float, firsts: Indices, seconds: Indices) -> Floats:
        """The log-likelihood ratios (k,) by looks and label that pairs are one thing, if the
        second map is turned by an angle."""
        one, other = self._looks
        rows, columns = one.rows[firsts][:, :, None], other.rows[seconds][:, None]
        agree = self._labels[0][firsts] == self._labels[1][seconds]
        ratios = self._table.ratios(
            self._likeness[rows, columns],
            np.cos(one.sides[rows] - other.sides[columns] - angle),
            self._other_run,
            agree[:, None, None],
        )
        ratios = np.minimum(np.maximum(ratios, -_MOST_RATIO), _MOST_RATIO)
        sums = np.where((rows >= 0) & (columns >= 0), ratios, 0.0).sum((1, 2))
        return self._of_things(sums / (one.counts[firsts] * other.counts[seconds]), firsts, seconds)

    def likely_pairs(self, of_each: int, most: int) -> tuple[Indices, Indices, Floats]:
        """The pairs of things that look most alike at the angle that suits them best, a few of each
        thing, best first, and their ratios (`TURNS`, k): under a turn by 2π t / `TURNS`."""
        rough = self._rough_ratios()
        firsts, seconds = _best_of_each(rough, of_each * _LOOKED_INTO)
        ratios = np.array([self.ratios_at(turn, firsts, seconds) for turn in _TURNS])
        rough[:] = -np.inf
        rough[firsts, seconds] = ratios.max(0)
        chosen = np.zeros(rough.shape, np.bool_)
        chosen[_best_of_each(rough, of_each)] = True
        of_pair = np.flatnonzero(chosen[firsts, seconds] & (ratios.max(0) > 0.0))
        best = of_pair[np.argsort(-ratios.max(0)[of_pair], kind="stable")[:most]]
        return firsts[best], seconds[best], ratios[:, best]

    def _rough_ratios(self) -> Floats:
        """The ratios (n, m) of all pairs by their mean likeness, seen from the side."""
        one, other = self._looks
        means = np.add.reduceat(self._likeness, one.rows[:, 0], 0)
        means = np.add.reduceat(means, other.rows[:, 0], 1)
        means /= one.counts[:, None] * other.counts[None]
        agree = self._labels[0][:, None] == self._labels[1][None]
        ratios = self._table.ratios(means, np.zeros((1, 1)), self._other_run, agree)
        firsts, seconds = np.ogrid[: agree.shape[0], : agree.shape[1]]
        return self._of_things(ratios, firsts, seconds)

    def _of_things(self, means: Floats, firsts: Indices, seconds: Indices) -> Floats:
        """The ratios of pairs of things by the mean ratios of their looks."""
        number = self._looks[0].counts[firsts] * self._looks[1].counts[seconds]
        agree = self._labels[0][firsts] == self._labels[1][seconds]
        by_label = np.where(agree, self._agreement[firsts], _OTHER_LABEL)
        found: Floats = means * np.minimum(np.sqrt(number), _MOST_LOOKS) + by_label
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
        values = -0.5 * chi2 - np.log(chance)
        near_enough = np.flatnonzero(chi2 < _GATE)
        firsts, seconds, values = (each[near_enough] for each in (firsts, seconds, values))
        values += self.ratios_at(transform[2], firsts, seconds)
        good = values > 0.0
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

    def tie_value(self, transform: Transform) -> float:
        """The log-likelihood ratio of the tie, against a pose anywhere on the ground that the first
        robot drove and at any angle; 0 without a tie."""
        if self.tie is None:
            return 0.0
        wide, high = np.ptp(self.first.poses[:, :2], axis=0) + 2.0 * _REACH_M
        _, _, error_m, error_rad = self.tie
        aside_m, turned = self.tie.apart(transform)
        chi2 = (aside_m / error_m) ** 2 + (turned / error_rad) ** 2
        chance = math.tau**1.5 * error_m**2 * error_rad / (float(wide * high) * math.tau)
        return -0.5 * chi2 - math.log(chance)

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
        gradient: Floats = np.einsum("nki,nkl,nl->i", slopes, weights, apart)
        if self.tie is not None:
            pose, to, error_m, error_rad = self.tie
            turned = pose[None, :2] @ rotation(transform[2]).T
            slope = np.vstack((jacobians(turned)[0], (0.0, 0.0, 1.0)))
            off = np.append(to[:2] - turned[0] - transform[:2], 0.0)
            off[2] = math.remainder(float(to[2] - pose[2]) - transform[2], math.tau)
            weight = np.diag((error_m**-2, error_m**-2, error_rad**-2))
            information += slope.T @ weight @ slope
            gradient += slope.T @ weight @ off
        return information, gradient

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


def least_cut(
    count: int,
    edges: Sequence[tuple[int, int]],
    weights: Sequence[float],
    ends: tuple[int, int],
) -> float:
    """The least sum of weights, in whole numbers, of edges that keep two of ``count`` nodes
    connected."""
    both = np.array([*edges, *((other, one) for one, other in edges)]).reshape(-1, 2)
    flows = np.tile(np.rint(weights).astype(np.int32), 2)
    graph = coo_array((flows, (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    return float(maximum_flow(graph, *ends).flow_value)


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


def _best_of_each(table: Floats, number: int) -> tuple[Indices, Indices]:
    """The best pairs of each row and each column, by row."""
    chosen = np.zeros(table.shape, np.bool_)
    most = min(number, *table.shape)
    by_row = np.argsort(-table, 1, kind="stable")[:, :most]
    by_column = np.argsort(-table, 0, kind="stable")[:most]
    np.put_along_axis(chosen, by_row, values=True, axis=1)
    np.put_along_axis(chosen, by_column, values=True, axis=0)
    firsts, seconds = np.nonzero(chosen)
    return firsts, seconds
