"""Candidates for the transform between two frames: votes of pairs of pairs of things.

Two things of the first map and two of the second that may be the same, as far apart there as here,
give a transform. Each votes, by how alike they look and how exactly the distances agree, for where
the second map's middle comes to lie and for the angle. Cells with many votes are candidates.
"""

import math
from typing import Final

import numpy as np

from .matching import TURNS, Comparison, Floats, Indices, Transform, rotation

MOST: Final = 60
"""The most candidates."""
_MOST_PAIRS: Final = 500
_OF_EACH: Final = 5
_LEAST_M, _MOST_DIFFERENCE_M, _MOST_CHI2 = 0.8, 2.5, 6.0
_ALONG_M: Final = 0.15
_CELL_M, _SECTORS = 0.6, 32
_MOST_NEAR: Final = 4
_FAR: Final = 1 << 20
"""Cells are numbered from here, so that numbers are positive."""


def candidates(both: Comparison) -> list[Transform]:
    """The likeliest transforms, most votes first; at most `MOST`."""
    firsts, seconds = _likely_pairs(both.ratios.max(0))
    voted = _votes(both, firsts, seconds)
    if voted is None:
        return []
    x, y, angle, weight, length = voted
    place = np.column_stack((x / _CELL_M, y / _CELL_M, (angle % math.tau) / math.tau * _SECTORS))
    cells, sums = _cells(place, weight)
    sector = math.tau / _SECTORS
    found: list[tuple[float, float, float]] = []
    for cell in cells[np.argsort(-sums, kind="stable")][: 8 * MOST]:
        turned = np.abs(_wrapped(angle - cell[2] * sector))
        near = (np.abs(place[:, :2] - cell[:2]) < 2.0).all(1) & (turned < 1.2 * sector)
        by = weight[near]
        at = float(np.average(x[near], weights=by)), float(np.average(y[near], weights=by))
        by = by * length[near]
        to = math.atan2(float(by @ np.sin(angle[near])), float(by @ np.cos(angle[near])))
        if _is_new(found, (*at, to)):
            found.append((*at, to))
        if len(found) == MOST:
            break
    middle = both.second.middle
    return [
        (x - float(back[0]), y - float(back[1]), to)
        for x, y, to in found
        for back in (rotation(to) @ middle,)
    ]


def _likely_pairs(best: Floats) -> tuple[Indices, Indices]:
    """The pairs of things that look most alike, a few of each thing."""
    chosen = np.zeros(best.shape, np.bool_)
    most = min(_OF_EACH, *best.shape)
    by_row = np.argsort(-best, 1, kind="stable")[:, :most]
    by_column = np.argsort(-best, 0, kind="stable")[:most]
    np.put_along_axis(chosen, by_row, values=True, axis=1)
    np.put_along_axis(chosen, by_column, values=True, axis=0)
    firsts, seconds = np.nonzero(chosen & (best > 0.0))
    order = np.argsort(-best[firsts, seconds], kind="stable")[:_MOST_PAIRS]
    return firsts[order], seconds[order]


def _votes(
    both: Comparison, firsts: Indices, seconds: Indices
) -> tuple[Floats, Floats, Floats, Floats, Floats] | None:
    """Where the second map's middle comes to lie (x, y), the angle, the weight and the length of
    each vote."""
    a, b = np.triu_indices(len(firsts), 1)
    apart = (firsts[a] != firsts[b]) & (seconds[a] != seconds[b])
    a, b = a[apart], b[apart]
    here = both.first.xy[firsts[b]] - both.first.xy[firsts[a]]
    there = both.second.xy[seconds[b]] - both.second.xy[seconds[a]]
    length, other = np.hypot(*here.T), np.hypot(*there.T)
    fits = (length > _LEAST_M) & (other > _LEAST_M)
    fits &= np.abs(length - other) < _MOST_DIFFERENCE_M
    a, b, here, there, length, other = (each[fits] for each in (a, b, here, there, length, other))
    variance = 2.0 * _ALONG_M**2 + _along(both, firsts, seconds, (a, b), here, there)
    chi2 = (length - other) ** 2 / variance
    angle = np.arctan2(here[:, 1], here[:, 0]) - np.arctan2(there[:, 1], there[:, 0])
    turn = np.rint((angle % math.tau) / math.tau * TURNS).astype(np.intp) % TURNS
    ratios = np.minimum(*(both.ratios[turn, firsts[each], seconds[each]] for each in (a, b)))
    fits = (chi2 < _MOST_CHI2) & (ratios > 0.0) & (np.sqrt(variance) < 0.5 * length)
    if not fits.any():
        return None
    a, b, angle, length = a[fits], b[fits], angle[fits], length[fits]
    weight = ratios[fits] * np.exp(-0.5 * chi2[fits]) / (1.0 + np.sqrt(variance[fits]))
    middle = both.second.middle
    first = 0.5 * (both.first.xy[firsts[a]] + both.first.xy[firsts[b]])
    second = 0.5 * (both.second.xy[seconds[a]] + both.second.xy[seconds[b]]) - middle
    cos, sin = np.cos(angle), np.sin(angle)
    x = first[:, 0] - (cos * second[:, 0] - sin * second[:, 1])
    y = first[:, 1] - (sin * second[:, 0] + cos * second[:, 1])
    return x, y, angle, weight, length


def _along(
    both: Comparison,
    firsts: Indices,
    seconds: Indices,
    ends: tuple[Indices, Indices],
    here: Floats,
    there: Floats,
) -> Floats:
    """The variance of the difference of two distances, by the covariances of the four ends."""
    total = np.zeros(len(here))
    for things, numbers, line in ((both.first, firsts, here), (both.second, seconds, there)):
        unit = line / np.hypot(*line.T)[:, None]
        for end in ends:
            total += np.einsum("ni,nij,nj->n", unit, things.covariance[numbers[end]], unit)
    return total


def _cells(place: Floats, weight: Floats) -> tuple[Indices, Floats]:
    """The cells (k, 3) with votes and the sum of each; a vote is shared by the eight around it."""
    base = np.floor(place).astype(np.int64)
    share = place - base
    corners = np.array([(x, y, t) for x in (0, 1) for y in (0, 1) for t in (0, 1)])
    every = (base[:, None] + corners).reshape(-1, 3)
    every[:, 2] %= _SECTORS
    parts = np.where(corners[None] == 1, share[:, None], 1.0 - share[:, None]).prod(2)
    keys = ((every[:, 0] + _FAR) * (2 * _FAR) + every[:, 1] + _FAR) * _SECTORS + every[:, 2]
    _, one, of = np.unique(keys, return_index=True, return_inverse=True)
    sums = np.zeros(len(one))
    np.add.at(sums, of, (weight[:, None] * parts).ravel())
    return every[one].astype(np.intp), sums


def _is_new(found: list[tuple[float, float, float]], one: tuple[float, float, float]) -> bool:
    """Whether a candidate is no repetition, and not the fifth about one spot."""
    apart = [
        (math.dist(one[:2], e[:2]), abs(math.remainder(one[2] - e[2], math.tau))) for e in found
    ]
    if any(way <= 0.5 and turn <= 0.15 for way, turn in apart):
        return False
    return sum(way < 1.5 and turn < 0.5 for way, turn in apart) < _MOST_NEAR


def _wrapped(angles: Floats) -> Floats:
    wrapped: Floats = (angles + math.pi) % math.tau - math.pi
    return wrapped
