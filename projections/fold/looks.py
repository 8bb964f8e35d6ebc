"""Looks: the log-likelihood ratio that two embeddings are of one thing.

Cosines are taken as relative likeness u (`projections.fold.evidence`). For one thing u is normal
about a mean that falls with the change of side and between runs,

    μ = same_back + same_side · exp(κ (cos Δ − 1)) − session_shift in another run

and counts as μ where it is above. For two things it is a mixture of look-alikes (a little below μ),
other things of the class, and things of another class; its shares depend on whether the labels
agree. Of a sum of densities the largest term is taken, so that a pair needs no exponential.

Looks are kept as integer multiples of 2⁻¹¹ in float32: by Cauchy and Schwarz every partial sum of a
product is at most about 2²², below 2²⁴, so products of matrices are exact with every BLAS.
"""

import math
from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from . import State
from .evidence import EvidenceConstants
from .exact import UNIT, exp, log

Floats = NDArray[np.float64]
Looks = NDArray[np.float32]
"""Rows of multiples of 2⁻¹¹."""
LOOK_UNIT = 1 << 11
Exemplar = tuple[float, float, float, int, int, int]
"""1 / length of a look, line of sight (cosine, sine), run, kind of exemplar, row in the matrix."""
_STEPS = 32
_WORST = 8.0
_LOOK_ALIKE = 0.05
_SHARES = (0.02, 0.1, 0.88), (0.15, 0.85, 0.1)
"""Shares of look-alikes, others of the class and others, for two things whose labels differ, and
agree."""
_LEAST_LIKENESS, _PER_LIKENESS, _LIKENESSES = -1.0, 128.0, 289
_OF_ONE_RUN = (_STEPS + 1) * _LIKENESSES
"""Indices of the table by whether the labels agree and the runs differ."""
_BEST = 4
_MISSING = 0.125
"""The number of exemplars that count, the best ones; each missing one costs an eighth."""
_RECENT = 8
_ENOUGH_PAIRS = 3_000
_FIRST_GUESS, _GUESS_WEIGHT = 0.5, 0.5


def looks_of(vectors: Sequence[Floats]) -> tuple[Looks, list[float]]:
    """Looks of unit vectors in multiples of 2⁻²⁰, and the inverses of their lengths. An empty
    vector has no look: a row of zeros, and 0."""
    are_looks = [len(vector) > 0 for vector in vectors]
    if not all(are_looks):
        nothing = np.zeros(max(map(len, vectors)))
        vectors = [vector if len(vector) else nothing for vector in vectors]
    looks = np.array(vectors, np.float32)  # exact: 21 bits
    looks *= np.float32(LOOK_UNIT / UNIT)
    np.rint(looks, out=looks)
    return looks, [
        1.0 / math.sqrt(max(float(look.dot(look)), 1.0)) if is_look else 0.0
        for look, is_look in zip(looks, are_looks, strict=True)
    ]


class LookRatios:
    """Ratios for arrays of pairs, from a table over likeness and change of side."""

    def __init__(self, constants: EvidenceConstants) -> None:
        c = constants
        sides = [exp(c.same_kappa * (2.0 * k / _STEPS - 2.0)) for k in range(_STEPS + 1)]
        of_run = np.array([c.same_back + c.same_side * side for side in sides])
        means = np.array([of_run, of_run - c.session_shift])[:, :, np.newaxis]
        likeness = np.arange(_LIKENESSES) / _PER_LIKENESS + _LEAST_LIKENESS
        below = (likeness - means) / c.same_spread
        z = np.minimum(below, 0.0)
        same = np.maximum(z * z * -0.5, -_WORST)
        alike = np.minimum(below + _LOOK_ALIKE / c.same_spread, 0.0)
        of_class = (likeness - c.same_class) / c.same_class_spread
        other = likeness / c.different_spread
        class_height = log(c.same_spread) - log(c.same_class_spread)
        other_height = log(c.same_spread) - log(c.different_spread)
        parts = []
        for shares in _SHARES:
            different = alike * alike * -0.5 + log(shares[0])
            one = of_class * of_class * -0.5 + (log(shares[1]) + class_height)
            different = np.maximum(different, one)
            one = other * other * -0.5 + (log(shares[2]) + other_height)
            parts.append(same - np.maximum(different, one))
        self._table = np.array(parts).ravel()  # agree, other run, side, likeness
        self._flat = array("d", self._table.tobytes())  # quicker for one number
        self._best = [-log(shares[0]) for shares in _SHARES]

    def at_best(self, labels_agree: bool) -> float:
        """The largest ratio at likenesses that occur. Far below those, where the likelihood of one
        thing is cut off at `_WORST` and that of two is not, ratios are larger."""
        return self._best[labels_agree]

    def of_exemplars(
        self,
        dots: list[float],
        exemplars: Sequence[Exemplar],
        inverse: float,
        cos: float,
        sin: float,
        run: int,
        labels_agree: bool,
        different: float,
    ) -> tuple[float, float]:
        """The ratio of a look and the exemplars of a thing, and the best cosine. ``dots`` are the
        products of the look and each exemplar by its row."""
        per_cosine = 1.0 / (1.0 - different)
        table, first = self._flat, labels_agree * (2 * _OF_ONE_RUN)
        best = -1.0
        ratios: list[float] = []
        for other_inverse, other_cos, other_sin, other_run, _, row in exemplars:
            cosine = dots[row] * other_inverse * inverse
            if cosine > best:
                best = cosine
            place = round(((cosine - different) * per_cosine - _LEAST_LIKENESS) * _PER_LIKENESS)
            if place < 0:
                place = 0
            elif place >= _LIKENESSES:
                place = _LIKENESSES - 1
            step = round((other_cos * cos + other_sin * sin + 1.0) * (_STEPS / 2))
            if other_run != run:
                place += _OF_ONE_RUN
            ratios.append(table[first + step * _LIKENESSES + place])
        ratios.sort(reverse=True)
        count = min(len(ratios), _BEST)
        total = ratios[0]
        for rank in range(1, count):
            total += ratios[rank]
        return total / count - _MISSING * (_BEST - count), best

    def ratios(
        self,
        likeness: Floats,
        sides: Floats,
        other_run: NDArray[np.bool_],
        labels_agree: NDArray[np.bool_],
    ) -> Floats:
        """``sides`` are cosines of the change of side; the arrays broadcast. Likeness and side are
        rounded to the table's steps, far below their spreads."""
        place = np.rint((likeness - _LEAST_LIKENESS) * _PER_LIKENESS)
        place = np.minimum(np.maximum(place, 0.0), _LIKENESSES - 1.0)
        step = np.minimum(np.maximum(np.rint((sides + 1.0) * (_STEPS / 2)), 0.0), float(_STEPS))
        row = labels_agree * (2.0 * (_STEPS + 1)) + other_run * (_STEPS + 1.0) + step
        ratios: Floats = self._table.take((row * _LIKENESSES + place).astype(np.intp))
        return ratios


class LookScale:
    """The mean cosine of different things, learned from pairs with different labels in one picture
    or in pictures next to each other: nearly all are different things."""

    def __init__(self, stated: float | None) -> None:
        self._stated = stated
        self._sum, self._count = 0, 0
        self._recent: list[tuple[str, Looks]] = []

    def different(self) -> float:
        """The mean cosine; starts from a guess that a single pair outweighs."""
        if self._stated is not None:
            return self._stated
        total = self._sum / (LOOK_UNIT * LOOK_UNIT) + _FIRST_GUESS * _GUESS_WEIGHT
        return total / (self._count + _GUESS_WEIGHT)

    def learn(self, labels: Sequence[str], looks: Looks, inverses: Sequence[float]) -> None:
        """Count the pairs of a picture with different labels, of those that have looks."""
        if self._stated is not None or self._count >= _ENOUGH_PAIRS:
            return
        if not all(inverses):
            have = [row for row, inverse in enumerate(inverses) if inverse]
            labels, looks = [labels[row] for row in have], looks[have]
            if not have:
                return
        rows = list(zip(labels, looks, strict=True))
        both = self._recent + rows
        dots: list[list[float]] = (np.array([row for _, row in both]) @ looks.T).tolist()
        before = len(self._recent)
        for column, label in enumerate(labels):
            for row in range(before + column):
                if both[row][0] != label:
                    self._sum += int(dots[row][column])
                    self._count += 1
        self._recent = both[-_RECENT:]

    def dump(self) -> State:
        """The whole state, to be kept."""
        return {
            "sum": self._sum,
            "count": self._count,
            "labels": [label for label, _ in self._recent],
            "looks": np.array([row for _, row in self._recent], np.float32).astype(np.int16),
        }

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._sum, self._count = state["sum"], state["count"]
        rows = state["looks"].astype(np.float32)
        self._recent = list(zip(state["labels"], rows, strict=True))
