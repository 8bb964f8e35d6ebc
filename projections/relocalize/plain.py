"""The plain recipe, kept as the baseline everything else is measured against.

The ten nearest observations of each crop; each gives its similarity to the Place of its Object; the
Place with the greatest sum wins; the pose is its centroid.
"""

import math
from collections.abc import Sequence

from .answer import Answer, PoseHypothesis
from .candidates import Candidates, Match
from .evidence import ranked_places

PLAIN_NEIGHBOURS = 10


def plain_scores(matches: Sequence[Sequence[Match]]) -> dict[int, float]:
    """Sum of similarities by Place; summed exactly, so that no order matters."""
    given: dict[int, list[float]] = {}
    for row in matches:
        for match in row[:PLAIN_NEIGHBOURS]:
            if match.object_place is not None:
                given.setdefault(match.object_place, []).append(match.similarity)
    return {place: math.fsum(values) for place, values in given.items()}


def rank_plain(candidates: Candidates, top: int) -> Answer:
    """The plain recipe's answer. Its confidence is the winner's share of all similarity."""
    scores = plain_scores(candidates.matches)
    if not scores:
        return Answer((), None, 0.0)
    order = sorted(scores, key=lambda place: (-scores[place], place))
    winner = candidates.places[order[0]]
    share = scores[order[0]] / math.fsum(scores.values())
    places = ranked_places(candidates, order[:top], scores)
    spread = _spread(candidates, order[0], winner.x, winner.y)
    return Answer(
        places, PoseHypothesis(winner.x, winner.y, None, spread), max(0.0, min(1.0, share))
    )


def _spread(candidates: Candidates, place: int, x: float, y: float) -> float:
    """Root mean square distance of the poses that voted for the place from its centroid."""
    squared = [
        (m.pose[0] - x) ** 2 + (m.pose[1] - y) ** 2
        for row in candidates.matches
        for m in row[:PLAIN_NEIGHBOURS]
        if m.object_place == place and m.pose is not None
    ]
    return math.sqrt(math.fsum(squared) / len(squared)) if squared else 0.0
