"""Places in their order, each with the observations that speak for it: the best one per crop."""

from collections.abc import Mapping, Sequence

from .answer import Evidence, RankedPlace
from .candidates import Candidates, Match


def ranked_places(
    candidates: Candidates, order: Sequence[int], scores: Mapping[int, float]
) -> tuple[RankedPlace, ...]:
    """The places of ``order`` (ordinals) with their scores and evidence."""
    ranked = []
    for place in order:
        spot = candidates.places[place]
        evidence = _evidence(candidates.matches, place)
        ranked.append(RankedPlace(spot.place_id, scores[place], spot.x, spot.y, evidence))
    return tuple(ranked)


def _evidence(matches: Sequence[Sequence[Match]], place: int) -> tuple[Evidence, ...]:
    best = [next((m for m in row if speaks_for(m, place)), None) for row in matches]
    found = sorted((m for m in best if m is not None), key=lambda m: (-m.similarity, m.observation))
    return tuple(Evidence(m.det_id, m.object_id, m.class_name, m.similarity) for m in found)


def speaks_for(match: Match, place: int) -> bool:
    """Whether the match's Object is located in the place, or was seen from it."""
    return place in (match.object_place, match.keyframe_place)
