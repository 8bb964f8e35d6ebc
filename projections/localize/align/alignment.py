"""Find the transform between two maps' frames, and decide whether it may be used.

A transform is *sure* when its pairs' score, the share of what should be seen that is matched, the
runner-up and the predicted error all pass the stricter gate, *likely* when they pass the looser
one. Otherwise nothing is said of it: with few common things right and wrong look alike.
"""

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible

from .framed_things import FramedThings
from .matching import Comparison, MatchedPairs, Transform, jacobians, moved, rotation
from .votes import candidates

Verdict = Literal["sure", "likely", "unknown"]

USUALLY_ENOUGH: Final = 12
"""Common things from which nine of ten are decided."""
_FIRST_SLACK_M: Final = 0.45
_REFINED, _ELSEWHERE = 5, 10
_OTHER_M, _OTHER_RAD = 1.0, 0.35


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

    ``pairs`` are the Objects that are one thing: their ids in both maps and the value of each.
    ``second`` is the score of the best other transform's pairs. Of ``expected`` things, which the
    first robot looked at, ``matched`` are matched. ``se_m`` is the predicted standard error over
    the second map's keyframes, ``se_rad`` that of the angle, ``shift_m`` how far they are moved
    (root mean square).
    """

    transform: Transform
    pairs: tuple[tuple[str, str, float], ...]
    score: float
    second: float
    expected: int
    matched: int
    se_m: float
    se_rad: float
    shift_m: float

    @property
    def is_one_frame(self) -> bool:
        """Whether the maps are in one frame already: the transform moves less than its error."""
        return self.verdict != "unknown" and self.shift_m <= 2.0 * self.se_m

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


def align(first: FramedThings, second: FramedThings) -> Alignment | None:
    """The transform of ``second`` into the frame of ``first``; None if no two pairs agree. Raises
    MisuseError if their looks are of different embedding spaces."""
    spaces = [(each.space, each.looks.shape[1]) for each in (first, second)]
    if spaces[0] != spaces[1]:
        named = " and ".join(f"{visible(str(name))} ({size})" for name, size in spaces)
        raise MisuseError(
            f"the embeddings are of different spaces, {named}: `{advised('reembed')}` adds vectors"
            " of another model to a log, and --space chooses them"
        )
    both = Comparison(first, second)
    found = candidates(both)
    if not found:
        return None
    rough = [both.matching(each, _FIRST_SLACK_M).score for each in found]
    order = sorted(range(len(found)), key=lambda i: (-rough[i], i))
    refined = [both.refined(found[i]) for i in order[:_REFINED]]
    best = max(refined, key=lambda each: each.score)
    middle = second.middle[None]
    far = [found[i] for i in order[_REFINED:] if _is_other(found[i], best.transform, middle)]
    refined += [both.refined(each) for each in far[:_ELSEWHERE]]
    best = max(refined, key=lambda each: each.score)
    if len(best) < 2:
        return None
    return _judged(both, best, refined)


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
    covariance = np.linalg.inv(both.information(best))
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
        best.score,
        runner_up,
        int(expected.sum()),
        int((expected & matched).sum()),
        math.sqrt(float(errors.mean())),
        math.sqrt(float(covariance[2, 2])),
        math.sqrt(float((shifts * shifts).sum(1).mean())),
    )


def decision_text(found: Alignment | None) -> str:
    """One line on whether a transform was found."""
    if found is None or found.verdict == "unknown":
        number = 0 if found is None else len(found.pairs)
        return (
            f"cannot tell: {counted(number, 'common thing')}; {USUALLY_ENOUGH} are usually enough"
        )
    common = counted(len(found.pairs), "common thing")
    if found.is_one_frame:
        return f"already in one frame, within {2.0 * found.se_m:.2f} m: {common}"
    x, y, angle = found.transform
    sure = "" if found.verdict == "sure" else ", but not surely"
    return (
        f"moved by ({x:.2f}, {y:.2f}) m and turned by {math.degrees(angle):.1f}°, "
        f"± {found.se_m:.2f} m{sure}: {common}, "
        f"{found.matched} of {found.expected} that should be seen, score {found.score:.0f}, "
        f"the next best {found.second:.0f}"
    )
