"""Find the map that a question is from: ask the databases of all sites, several at once.

Scores of places cannot be compared across maps: they are shares of one map's poses. The two
probabilities of an answer can, as each map calibrates them: `known`, that it has the things shown,
and `confidence`, that the pose found is right. Their logits are the evidence for a map against
"none of them" (docs/decisions/which-building.md). The prior is equal for all sites; that of "none"
is its share in the questions that the weights were fitted on.
"""

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

from eventsrc.base.errors import MapfoldError
from eventsrc.base.text import advised
from eventsrc.log.sealed_end import segments_of
from projections.fold.exact import exp
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import Answer, Question, rank
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import CandidateReader

from .site_databases import exists
from .sites import Site

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
    of_confidence = CONFIDENCE_WEIGHT * _logit(answer.confidence)
    return INTERCEPT + KNOWN_WEIGHT * _logit(answer.known) + of_confidence


def _logit(probability: float) -> float:
    within = min(1.0 - _LEAST, max(_LEAST, probability))
    return math.log(within / (1.0 - within))


@dataclass(frozen=True, slots=True)
class FleetAnswer:
    """The ranking of the sites that could be asked, and why the others could not."""

    which: WhichSite
    not_asked: Mapping[str, str]


def ask_sites(
    sites: Sequence[Site],
    databases: Mapping[str, Targets],
    question: Question,
    *,
    top: int,
    camera: CameraConstants | None,
    jobs: int,
) -> FleetAnswer:
    """Ask each site; one that cannot be asked does not affect the ranking of the others."""
    with ThreadPoolExecutor(jobs, "ask") as threads:  # it mostly waits for the databases
        answers = threads.map(
            lambda site: _ask(site, databases[site.name], question, top=top, camera=camera), sites
        )
        found = {site.name: answer for site, answer in zip(sites, answers, strict=True)}
    return FleetAnswer(
        which_site({name: a for name, a in found.items() if isinstance(a, Answer)}),
        {name: a for name, a in found.items() if isinstance(a, str)},
    )


def _ask(
    site: Site, databases: Targets, question: Question, *, top: int, camera: CameraConstants | None
) -> Answer | str:
    """The answer of one site's map, or the reason why there is none."""
    try:
        for url in databases.urls:
            if exists(url) is False:
                segments_of(site.log)  # raises where there is no log to replay
                return f"there is no such database yet; `{advised('fleet', 'replay')}` makes it"
        with CandidateReader(databases) as reader:
            candidates = reader.candidates(question.crops)
        return rank(question, candidates, top=top, camera=camera)
    except MapfoldError as error:
        return str(error)
