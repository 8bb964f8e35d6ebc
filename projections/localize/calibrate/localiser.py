"""Scores of re-localisation on a map's own questions, and the correction of its two probabilities.

The map is asked its own questions (`projections.localize.evaluate.own_questions`). A logit z of
`known` or of `confidence` is compared with whether it was right: the scale and shift are fitted,
drawn towards those of own questions on the maps that the weights were fitted on. Own questions
differ from those of another day, since leaving out a visit is not the same as never having made it,
so only the difference from those maps is the correction.

Machines agree on the correction. What `known` is computed from is exact, and the line is fitted
with exactly rounded sums and `projections.fold.exact`. `confidence` and the error of the
pose come from numpy and libm, which differ in the last bits; that is why logits are rounded to
multiples of 2⁻¹⁰ before the fit and constants to three decimals after it. What can still differ: a
last bit that moves an error across 1.5 m, or that decides between two poses of equal weight,
changes whether an answer is right. One such answer of a hundred moves the constants of `confidence`
by about 0.01.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from projections.fold.exact import exp, log
from projections.fold.settings import LocalizerConstants
from projections.localize.evaluate.own_questions import OwnAnswer, ask_own_questions
from projections.localize.relocalize.certainty import probability
from projections.map.view import MapView

CROPS = (1, 3)


class Line(NamedTuple):
    """A logit z is right with the probability of scale · z + shift."""

    scale: float
    shift: float


KNOWN_USUAL = Line(0.81, 0.62)
CONFIDENCE_USUAL = Line(0.93, -0.24)
"""The lines fitted to own questions of the maps that the weights were fitted on
(`scripts/fit_confidence`)."""
KNOWN_FIRMNESS, CONFIDENCE_FIRMNESS = 12.0, 64.0
"""The precision of the prior of a map's line: that of its shift; that of its scale is four times as
much. A question whose logit is near 0 has a precision of a quarter. How near poses are on own
questions depends on the drive as much as on the map, so the line of `confidence` hardly moves."""
_THIN = 100
"""Chosen on the developing half: the worst map loses 0.03 in log loss of `known` on another day,
with the full weight 0.09."""
_FIRM = 1e-9
_ROUNDS = 60
_ENOUGH = 1e-12
_STEPS_OF_A_LOGIT = 1024
_DECIMALS = 3
_BOUNDS = (Line(0.25, -4.0), Line(4.0, 4.0))


@dataclass(frozen=True, slots=True)
class OwnScores:
    """The results of the map's own questions. ``answers`` are those without a correction,
    ``constants`` the correction."""

    answers: tuple[OwnAnswer, ...]
    constants: LocalizerConstants

    def known(self, answer: OwnAnswer) -> float:
        """The probability that an answer's things are in the map, with the correction."""
        c = self.constants
        return _corrected(answer.answer.known, c.known_scale, c.known_shift)

    def confidence(self, answer: OwnAnswer) -> float:
        """The probability that its pose is right, with the correction."""
        c = self.constants
        return _corrected(answer.answer.confidence, c.confidence_scale, c.confidence_shift)


NOT_ASKED = OwnScores((), LocalizerConstants())


def read_localiser(view: MapView) -> OwnScores:
    """Ask a map, whose settings must have no correction, its own questions."""
    answers = tuple(each for crops in CROPS for each in ask_own_questions(view, crops))
    return OwnScores(answers, correction(answers, len(view.observations)))


def correction(answers: Sequence[OwnAnswer], observations: int) -> LocalizerConstants:
    """The constants that calibrate the probabilities of a map of so many observations; the defaults
    without answers. Questions to a small map are about few things: those of `known` have the weight
    n / (n + 100)."""
    said, is_known = [_stepped(a.answer.known) for a in answers], [a.known for a in answers]
    sure, is_right = [_stepped(a.answer.confidence) for a in answers], [a.correct for a in answers]
    firmness = KNOWN_FIRMNESS * (observations + _THIN) / max(observations, 1)
    known = _correction_of(fit_line(said, is_known, KNOWN_USUAL, firmness), KNOWN_USUAL)
    confidence = _correction_of(
        fit_line(sure, is_right, CONFIDENCE_USUAL, CONFIDENCE_FIRMNESS), CONFIDENCE_USUAL
    )
    return LocalizerConstants(
        known_scale=known.scale,
        known_shift=known.shift,
        known_count=len(answers),
        confidence_scale=confidence.scale,
        confidence_shift=confidence.shift,
        confidence_count=len(answers),
    )


def fit_line(logits: Sequence[float], right: Sequence[bool], usual: Line, firmness: float) -> Line:
    """The maximum a posteriori line, with the usual line as the prior."""
    pairs = [(z, 1.0 if is_right else 0.0) for z, is_right in zip(logits, right, strict=True)]
    scale, shift = usual
    for _ in range(_ROUNDS):
        up, up_z = [-firmness * (shift - usual.shift)], [-4.0 * firmness * (scale - usual.scale)]
        bend, bend_z, bend_zz = [firmness], [0.0], [4.0 * firmness]
        for z, y in pairs:
            p = 1.0 / (1.0 + exp(-min(max(scale * z + shift, -30.0), 30.0)))
            unsure = p * (1.0 - p)
            up.append(y - p)
            up_z.append((y - p) * z)
            bend.append(unsure)
            bend_z.append(unsure * z)
            bend_zz.append(unsure * z * z)
        by_shift, by_scale = math.fsum(up), math.fsum(up_z)
        a, b, c = math.fsum(bend), math.fsum(bend_z), math.fsum(bend_zz)
        size = a * c - b * b  # above 0, as a and c hold the firmness
        to_shift = (c * by_shift - b * by_scale) / size
        to_scale = (a * by_scale - b * by_shift) / size
        shift += min(max(to_shift, -1.0), 1.0)
        scale += min(max(to_scale, -1.0), 1.0)
        if max(abs(to_shift), abs(to_scale)) < _ENOUGH:
            break
    return Line(scale, shift)


def _correction_of(line: Line, usual: Line) -> Line:
    """The correction, bounded: the line that turns a logit of this map into one that the usual line
    fits."""
    least, most = _BOUNDS
    scale, shift = line.scale / usual.scale, (line.shift - usual.shift) / usual.scale
    return Line(
        round(min(max(scale, least.scale), most.scale), _DECIMALS),
        round(min(max(shift, least.shift), most.shift), _DECIMALS) + 0.0,
    )


def logit(p: float) -> float:
    """The logit of a probability, not beyond that of one in 10⁹."""
    p = min(max(p, _FIRM), 1.0 - _FIRM)
    return log(p / (1.0 - p))


def _stepped(p: float) -> float:
    """The logit as the nearest multiple of 2⁻¹⁰, in which a last bit of p is seldom seen."""
    return round(logit(p) * _STEPS_OF_A_LOGIT) / _STEPS_OF_A_LOGIT


def _corrected(p: float, scale: float, shift: float) -> float:
    return probability(logit(p), scale, shift)
