"""Find the transform between two maps' frames, and decide whether it may be used.

A transform is *sure* when its pairs' score, the share of what should be seen that is matched, the
runner-up and the predicted error all pass the stricter gate, *likely* when they pass the looser
one. Otherwise nothing is said of it: with few common things right and wrong look alike.

Candidates come from votes of pairs of pairs of things: two things of the first map and two of the
second that may be the same, as far apart there as here, give a transform. Each votes, by how alike
they look and how exactly the distances agree, for where the second map's middle comes to lie and
for the angle. Cells with many votes are candidates.
"""

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible

from .framed_things import FramedThings
from .matching import (
    TURNS,
    Comparison,
    Floats,
    Indices,
    MatchedPairs,
    Tie,
    Transform,
    jacobians,
    moved,
    rotation,
)

Verdict = Literal["sure", "likely", "unknown"]

USUALLY_ENOUGH: Final = 12
"""Common things from which nine of ten are decided."""
_FIRST_SLACK_M: Final = 0.45
_ERRORS: Final = 3.0
"""Standard errors within which a tie is kept."""
_REFINED, _ELSEWHERE = 5, 10
_OTHER_M, _OTHER_RAD = 1.0, 0.35
_MOST: Final = 60
"""The most candidates."""
_MOST_PAIRS: Final = 500
_OF_EACH: Final = 5
_LEAST_M, _MOST_DIFFERENCE_M, _MOST_CHI2 = 0.8, 2.5, 6.0
_ALONG_M: Final = 0.15
_CELL_M, _SECTORS = 0.6, 32
_MOST_NEAR: Final = 4
_FAR: Final = 1 << 20
"""Cells are numbered from here, so that numbers are positive."""


class Gate(NamedTuple):
    """Least score and share matched; the most of the runner-up's score, and of the error, m."""

    score: float
    share: float
    second: float
    se_m: float


SURE: Final = Gate(40.0, 0.4, 0.5, 0.6)
LIKELY: Final = Gate(20.0, 0.4, 0.75, 0.6)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The best transform of the second map into the first one's frame, metres and radians.

    ``pairs`` are the Objects that are one thing: their ids in both maps and the value of each;
    ``classes`` what each is in the first one.
    ``second`` is the score of the best other transform's pairs. Of ``expected`` things, which the
    first robot looked at, ``matched`` are matched. ``se_m`` is the predicted standard error over
    the second map's keyframes, ``se_rad`` that of the angle, ``shift_m`` how far they are moved
    (root mean square). ``information`` is the inverse covariance (3, 3) of the transform.
    """

    transform: Transform
    pairs: tuple[tuple[str, str, float], ...]
    classes: tuple[str, ...]
    score: float
    second: float
    expected: int
    matched: int
    se_m: float
    se_rad: float
    shift_m: float
    information: Floats

    @property
    def is_one_frame(self) -> bool:
        """Whether the maps are in one frame already: the transform moves less than its error."""
        return self.verdict != "unknown" and self.shift_m <= 2.0 * self.se_m

    @property
    def is_ambiguous(self) -> bool:
        """Whether another transform, as of a place that looks alike, is nearly as good."""
        return self.score >= LIKELY.score and self.second > LIKELY.second * self.score

    @property
    def verdict(self) -> Verdict:
        """Whether it may be used."""
        if self._passes(SURE):
            return "sure"
        return "likely" if self._passes(LIKELY) else "unknown"

    def _passes(self, gate: Gate) -> bool:
        return (
            self.score >= gate.score
            and self.matched >= gate.share * self.expected
            and self.second <= gate.second * self.score
            and self.se_m <= gate.se_m
        )

    def best_pairs(self, number: int) -> list[str]:
        """The pairs of the highest value in words."""
        named = zip(self.classes, self.pairs, strict=True)
        best = sorted(named, key=lambda each: -each[1][2])[:number]
        return [f"{visible(kind)} {one} = {other}" for kind, (one, other, _) in best]

    def document(self) -> dict[str, Any]:
        """The alignment as JSON."""
        x, y, angle = self.transform
        return {
            "verdict": self.verdict,
            "transform": {"x": x, "y": y, "yaw_rad": angle},
            "se_m": self.se_m,
            "se_rad": self.se_rad,
            "shift_m": self.shift_m,
            "common": len(self.pairs),
            "score": self.score,
            "second_score": self.second,
            "expected": self.expected,
            "matched": self.matched,
            "pairs": [
                {"to": one, "from": other, "value": value} for one, other, value in self.pairs
            ],
        }


def align(first: FramedThings, second: FramedThings, tie: Tie | None = None) -> Alignment | None:
    """The transform of ``second`` into the frame of ``first``; None if no two pairs agree. Given a
    tie, the best one that keeps it, whose score the tie adds to, and that the maps are in one frame
    already may be the runner-up. Raises MisuseError if their looks are of different embedding
    spaces."""
    spaces = [(each.space, each.looks.shape[1]) for each in (first, second)]
    if spaces[0] != spaces[1]:
        named = " and ".join(f"{visible(str(name))} ({size})" for name, size in spaces)
        raise MisuseError(
            f"the embeddings are of different spaces, {named}: `{advised('reembed')}` adds vectors"
            " of another model to a log, and --space chooses them"
        )
    both = Comparison(first, second, tie)
    refined = _refined(both, _candidates(both) + ([] if tie is None else [tie.transform]))
    best = max(refined, key=lambda each: each.score, default=None)
    if best is None or len(best) < 2:
        return None
    if tie is not None:
        refined.append(Comparison(first, second).refined((0.0, 0.0, 0.0)))
    return _judged(both, best, refined)


def _refined(both: Comparison, found: list[Transform]) -> list[MatchedPairs]:
    """The matchings near the candidates that promise most, and near some that lie elsewhere."""
    rough = [both.matching(each, _FIRST_SLACK_M).score for each in found]
    order = sorted(range(len(found)), key=lambda i: (-rough[i], i))
    refined = [both.refined(found[i]) for i in order[:_REFINED]]
    if not refined:
        return []
    best, middle = max(refined, key=lambda each: each.score), both.second.middle[None]
    far = [found[i] for i in order[_REFINED:] if _is_other(found[i], best.transform, middle)]
    return refined + [both.refined(each) for each in far[:_ELSEWHERE]]


def _is_other(one: Transform, other: Transform, middle: NDArray[np.float64]) -> bool:
    apart = moved(middle, one)[0] - moved(middle, other)[0]
    turned = abs(math.remainder(one[2] - other[2], math.tau))
    return math.hypot(*apart) > _OTHER_M or turned > _OTHER_RAD


def _judged(both: Comparison, best: MatchedPairs, refined: list[MatchedPairs]) -> Alignment:
    first, second = both.first, both.second
    same, middle = best.pairs(), second.middle[None]
    runner_up = 0.0
    for each in refined:
        if _is_other(each.transform, best.transform, middle):
            pairs = zip(each.firsts.tolist(), each.seconds.tolist(), strict=True)
            own = [
                v for pair, v in zip(pairs, each.values.tolist(), strict=True) if pair not in same
            ]
            runner_up = max(runner_up, math.fsum(own))
    expected = both.is_expected(best.transform)
    matched = np.zeros(len(expected), np.bool_)
    matched[best.seconds] = True
    information = both.information(best)
    covariance = np.linalg.inv(information)
    slopes = jacobians(second.poses[:, :2] @ rotation(best.transform[2]).T)
    errors = np.einsum("nij,jk,nik->n", slopes, covariance, slopes)
    shifts = moved(second.poses[:, :2], best.transform) - second.poses[:, :2]
    return Alignment(
        best.transform,
        tuple(
            (first.object_ids[i], second.object_ids[j], value)
            for i, j, value in zip(
                best.firsts.tolist(), best.seconds.tolist(), best.values.tolist(), strict=True
            )
        ),
        tuple(first.classes[best.firsts].tolist()),
        best.score + both.tie_value(best.transform),
        runner_up,
        int(expected.sum()),
        int((expected & matched).sum()),
        math.sqrt(float(errors.mean())),
        math.sqrt(float(covariance[2, 2])),
        math.sqrt(float((shifts * shifts).sum(1).mean())),
        information,
    )


def decision_text(found: Alignment | None) -> str:
    """One line on whether a transform was found."""
    if found is None or found.verdict == "unknown":
        number = 0 if found is None else len(found.pairs)
        if found is not None and found.is_ambiguous:
            return (
                f"cannot tell: {counted(number, 'common thing')} with score {found.score:.0f}, but"
                f" another transform has {found.second:.0f}; some places look alike"
            )
        return (
            f"cannot tell: {counted(number, 'common thing')}; {USUALLY_ENOUGH} are usually enough"
        )
    common = counted(len(found.pairs), "common thing")
    move = move_text(found.transform, found.se_m, found.verdict, found.is_one_frame)
    if found.is_one_frame:
        return f"{move}: {common}"
    return (
        f"{move}: {common}, {found.matched} of {found.expected} that should be seen, score"
        f" {found.score:.0f}, the next best {found.second:.0f}"
    )


def move_text(transform: Transform, se_m: float, verdict: Verdict, is_one_frame: bool) -> str:
    """What a transform that was found does, with its standard error, in words."""
    if is_one_frame:
        return f"already in one frame, within {2.0 * se_m:.2f} m"
    x, y, angle = transform
    sure = "" if verdict == "sure" else ", but not surely"
    turned = f"turned by {math.degrees(angle):.1f}°, ± {se_m:.2f} m{sure}"
    return f"moved by ({x:.2f}, {y:.2f}) m and {turned}"


def _candidates(both: Comparison) -> list[Transform]:
    """The likeliest transforms, most votes first; at most `_MOST`."""
    voted = _votes(both, *both.likely_pairs(_OF_EACH, _MOST_PAIRS))
    if voted is None:
        return []
    x, y, angle, weight, length = voted
    if both.tie is not None:
        aside = both.tie.pose[:2] - both.second.middle
        cos, sin = np.cos(angle), np.sin(angle)
        to_x = x + cos * aside[0] - sin * aside[1] - both.tie.to[0]
        to_y = y + sin * aside[0] + cos * aside[1] - both.tie.to[1]
        keeps = np.hypot(to_x, to_y) < _ERRORS * both.tie.error_m + _FIRST_SLACK_M
        if not keeps.any():
            return []
        x, y, angle, weight, length = (each[keeps] for each in (x, y, angle, weight, length))
    place = np.column_stack((x / _CELL_M, y / _CELL_M, (angle % math.tau) / math.tau * _SECTORS))
    cells, sums = _cells(place, weight)
    order = np.argsort(place[:, 0], kind="stable")
    x, y, angle, weight, length, place = (
        each[order] for each in (x, y, angle, weight, length, place)
    )
    sector = math.tau / _SECTORS
    found: list[tuple[float, float, float]] = []
    for cell in cells[np.argsort(-sums, kind="stable")][: 8 * _MOST]:
        begin, end = np.searchsorted(place[:, 0], (cell[0] - 2.0, cell[0] + 2.0))
        turned = np.abs(_wrapped(angle[begin:end] - cell[2] * sector))
        aside = np.abs(place[begin:end, 1] - cell[1])
        near = begin + np.flatnonzero((aside < 2.0) & (turned < 1.2 * sector))
        by = weight[near]
        at = float(np.average(x[near], weights=by)), float(np.average(y[near], weights=by))
        by = by * length[near]
        to = math.atan2(float(by @ np.sin(angle[near])), float(by @ np.cos(angle[near])))
        if _is_new(found, (*at, to)):
            found.append((*at, to))
        if len(found) == _MOST:
            break
    middle = both.second.middle
    return [
        (x - float(back[0]), y - float(back[1]), to)
        for x, y, to in found
        for back in (rotation(to) @ middle,)
    ]


def _votes(
    both: Comparison, firsts: Indices, seconds: Indices, by_turn: Floats
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
    ratios = np.minimum(by_turn[turn, a], by_turn[turn, b])
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
