"""Estimate likenesses: of different things, and of one thing from other sides and in other runs.

Different things are the pairs of one picture. The likeness of one thing is estimated from pairs of
observations of a qualified thing. All likenesses but ``different`` are relative: (cosine −
different) / (1 − different).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from projections.fold.evidence import EvidenceConstants

from .qualified_things import Flags, Floats, Ints, QualifiedThing, Sightings
from .readings import PRIOR_COUNT, Reading, level, robust_spread, rounded, spread, unread

KAPPAS = (2.0, 1.0, 4.0)
"""The values that are tried; of equally good ones the first, which is the prior."""
FEWEST_DIFFERENT = 20
"""Pairs in pictures that the scale of likeness needs."""
_MOST_IN_A_PICTURE = 24
_MOST_PAIRS = 200_000
_MOST_OF_A_THING = 300
_A_PAIR = 2
_ROUNDS = 15


class LookPairs(NamedTuple):
    """Pairs of observations: the likeness of each, and what they have in common."""

    likeness: Floats
    same_side: Floats
    """Cosine of the change of the line of sight."""
    same_heading: Floats
    other_run: Flags
    weight: Floats


def in_pictures(seen: Sightings) -> tuple[Floats, Flags]:
    """The cosines of pairs in one picture, and whether both have one class."""
    first, second = _pairs_in_pictures(seen.picture)
    both = seen.looked[first] & seen.looked[second]
    first, second = first[both], second[both]
    stride = -(-len(first) // _MOST_PAIRS) or 1
    first, second = first[::stride], second[::stride]
    labels = np.array(list(seen.classes), dtype=object)
    same = np.array(labels[first] == labels[second], dtype=np.bool_)
    return seen.cosines(first, second), same


def _pairs_in_pictures(picture: Ints) -> tuple[Ints, Ints]:
    """Each observation with those of its picture that follow, up to `_MOST_IN_A_PICTURE`."""
    order = np.argsort(picture, kind="stable")
    first, second = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for step in range(1, _MOST_IN_A_PICTURE):
        together = np.flatnonzero(picture[order[step:]] == picture[order[:-step]])
        if not len(together):
            break
        first.append(order[together])
        second.append(order[together + step])
    return np.concatenate(first), np.concatenate(second)


def scale(cosines: Floats, same_class: Flags) -> Reading:
    """``different``: the mean cosine of different things of different classes."""
    other = cosines[~same_class]
    if len(other) < FEWEST_DIFFERENT:
        return Reading("different", None, None, None, len(other))
    value = rounded(float(other.mean()))
    return Reading("different", min(value, 0.9999), value, None, len(other))


def different(
    likeness: Floats, same_class: Flags, prior: EvidenceConstants
) -> tuple[Reading, Reading, Reading]:
    """The spread of different things of different classes; mean and spread of those of one."""
    other, same = likeness[~same_class], likeness[same_class]
    about_other = robust_spread(other) if len(other) else math.nan
    middle = float(np.median(same)) if len(same) else math.nan
    about_same = robust_spread(same - middle) if len(same) else math.nan
    return (
        spread("different_spread", about_other, prior.different_spread, len(other)),
        level("same_class", middle, prior.same_class, len(same)),
        spread("same_class_spread", about_same, prior.same_class_spread, len(same)),
    )


def of_things(seen: Sightings, things: Sequence[QualifiedThing], scaled_by: float) -> LookPairs:
    """Pairs of observations of one thing; the pairs of a thing weigh as much as its
    observations."""
    first, second, weight = [], [], []
    for thing in things:
        rows = thing.rows[seen.looked[thing.rows]]
        if len(rows) < _A_PAIR:
            continue
        a, b = np.triu_indices(len(rows), 1)
        stride = -(-len(a) // _MOST_OF_A_THING)
        a, b = a[::stride], b[::stride]
        first.append(rows[a])
        second.append(rows[b])
        weight.append(np.full(len(a), len(rows) / len(a)))
    if not first:
        none = np.zeros(0)
        return LookPairs(none, none, none, none.astype(np.bool_), none)
    one, other = np.concatenate(first), np.concatenate(second)
    cosines = seen.cosines(one, other)
    return LookPairs(
        (cosines - scaled_by) / (1.0 - scaled_by),
        np.cos(seen.sight[one] - seen.sight[other]),
        np.cos(seen.heading[one] - seen.heading[other]),
        seen.run[one] != seen.run[other],
        np.concatenate(weight),
    )


def same(pairs: LookPairs, prior: EvidenceConstants) -> dict[str, Reading]:
    """The constants of the likeness of one thing from another side and in another run.

    The prior is added as pairs with the expected likeness, over all changes of side, half of them
    of two runs; κ and the kind of side are chosen by the least residual.
    """
    count = round(float(pairs.weight.sum()))
    between = round(float(pairs.weight[pairs.other_run].sum()))
    if not count:
        names = ("same_back", "same_side", "same_kappa", "same_spread", "side_by", "session_shift")
        return {name: unread(name, getattr(prior, name)) for name in names}
    fits = []
    for kappa in dict.fromkeys((prior.same_kappa, *KAPPAS)):
        for by, change in (("sight", pairs.same_side), ("heading", pairs.same_heading)):
            fits.append((_fit(pairs, change, kappa, prior), kappa, by))
    best, kappa, by = min(fits, key=lambda fit: fit[0].loss)  # the first of equal ones
    change = pairs.same_side if by == "sight" else pairs.same_heading
    alone = _fit(pairs, change, kappa, prior, prior_count=1)
    return {
        "same_back": _reading("same_back", best.back, alone.back, prior.same_back, count),
        "same_side": _reading("same_side", best.side, alone.side, prior.same_side, count),
        "same_kappa": Reading("same_kappa", kappa, kappa, prior.same_kappa, count),
        "same_spread": spread("same_spread", best.spread, prior.same_spread, count),
        "side_by": Reading("side_by", by, by, prior.side_by, count),
        "session_shift": _reading(
            "session_shift", best.shift, alone.shift, prior.session_shift, between
        ),
    }


def _reading(name: str, value: float, seen: float, prior: float, count: int) -> Reading:
    if not count:
        return unread(name, prior)
    return Reading(name, rounded(value), rounded(seen), prior, count)


class _Fit(NamedTuple):
    back: float
    side: float
    shift: float
    spread: float
    loss: float


def _fit(
    pairs: LookPairs, change: Floats, kappa: float, prior: EvidenceConstants, prior_count: int = 0
) -> _Fit:
    """Robust least squares of likeness = back + side · exp(κ (change − 1)) − shift · other_run."""
    prior_count = prior_count or PRIOR_COUNT
    usual = np.cos(np.linspace(0.0, math.pi, 10))
    usual = np.concatenate([usual, usual])
    usual_other = np.repeat([0.0, 1.0], 10)
    expected = (
        prior.same_back
        + prior.same_side * np.exp(prior.same_kappa * (usual - 1.0))
        - prior.session_shift * usual_other
    )
    own = len(pairs.likeness)
    sides = np.exp(kappa * (np.concatenate([change, usual]) - 1.0))
    others = np.concatenate([pairs.other_run.astype(np.float64), usual_other])
    target = np.concatenate([pairs.likeness, expected])
    counts = np.concatenate([pairs.weight, np.full(len(usual), prior_count / len(usual))])
    design = np.stack([np.ones(len(target)), sides, -others], axis=1)
    robust = np.ones(len(target))
    sigma = prior.same_spread
    found = np.array([prior.same_back, prior.same_side, prior.session_shift])
    for _ in range(_ROUNDS):
        found = _least_squares(design, target, counts * robust)
        left = target - design @ found
        capped = np.minimum(left[:own] ** 2, 9.0 * sigma**2)
        sigma = max(math.sqrt(float(pairs.weight @ capped / pairs.weight.sum())), 1e-3)
        robust = 1.0 / (1.0 + (left / (2.5 * sigma)) ** 2)
    loss = float(counts @ np.log1p((left / (2.0 * prior.same_spread)) ** 2))
    return _Fit(float(found[0]), float(found[1]), float(found[2]), sigma, loss)


def _least_squares(design: Floats, target: Floats, weight: Floats) -> Floats:
    """Weighted least squares; side and shift are not below 0."""
    keep = [0, 1, 2]
    while True:
        part = design[:, keep]
        normal = part.T @ (part * weight[:, None])
        solved = np.linalg.solve(normal, part.T @ (weight * target))
        below = [k for k, value in zip(keep, solved, strict=True) if k and value < 0.0]
        if not below:
            found = np.zeros(3)
            found[keep] = solved
            return found
        keep = [k for k in keep if k not in below]
