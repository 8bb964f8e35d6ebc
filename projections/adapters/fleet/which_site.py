"""Find the map that a question is from: the probability of each of several maps, and of none. Pure.

Scores of places cannot be compared across maps: they are shares of one map's poses. The two
probabilities of an answer can, as each map calibrates them: `known`, that it has the things shown,
and `confidence`, that the pose found is right. Their logits are the evidence for a map against
"none of them" (docs/decisions/which-building.md). The prior is equal for all sites; that of "none"
is its share in the questions that the weights were fitted on.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from projections.fold.exact_functions import exp
from projections.localize.relocalize import Answer

KNOWN_WEIGHT: Final = 0.863
CONFIDENCE_WEIGHT: Final = 0.470
INTERCEPT: Final = -0.568
"""Conditional logit with "none" at 0, fitted on the developing half of generated buildings: six
sites each, one of them the right one for about half of the questions."""
FITTED_SITES: Final = 6
_LEAST: Final = 1e-6
"""Least distance of clipped probabilities from 0 and 1, so that no single map decides."""


@dataclass(frozen=True, slots=True)
class RankedSite:
    """A site, the probability that the robot is there, and the answer of its map."""

    name: str
    probability: float
    answer: Answer

    def document(self) -> dict[str, Any]:
        """As JSON: the answer in the shape of ``relocalize --json``, with site and probability."""
        return {"site": self.name, "probability": self.probability} | self.answer.document()


@dataclass(frozen=True, slots=True)
class WhichSite:
    """The sites, likeliest first, and the probability that the robot is at none of them."""

    sites: tuple[RankedSite, ...]
    none: float

    @property
    def best(self) -> RankedSite | None:
        """The likeliest site; None where "none" is likelier than each."""
        if not self.sites or self.none >= self.sites[0].probability:
            return None
        return self.sites[0]


def which_site(answers: Mapping[str, Answer]) -> WhichSite:
    """Rank the sites by their answers to one question."""
    if not answers:
        return WhichSite((), 1.0)
    prior = math.log(FITTED_SITES / len(answers))
    names = sorted(answers)
    evidence = [prior + _evidence(answers[name]) for name in names]
    greatest = max(0.0, *evidence)
    weights = [exp(max(-700.0, value - greatest)) for value in evidence]
    none = exp(max(-700.0, -greatest))
    total = math.fsum([none, *weights])
    ranked = [
        RankedSite(name, weight / total, answers[name])
        for name, weight in zip(names, weights, strict=True)
    ]
    return WhichSite(tuple(sorted(ranked, key=lambda r: (-r.probability, r.name))), none / total)


def _evidence(answer: Answer) -> float:
    logits: Sequence[float] = [_logit(answer.known), _logit(answer.confidence)]
    return INTERCEPT + KNOWN_WEIGHT * logits[0] + CONFIDENCE_WEIGHT * logits[1]


def _logit(probability: float) -> float:
    within = min(1.0 - _LEAST, max(_LEAST, probability))
    return math.log(within / (1.0 - within))
