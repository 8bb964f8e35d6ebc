"""Scores: agreement of clusterings, places and objects against the truth, calibration, AUROC.

Homogeneity is 1 when each cluster holds one class only, completeness when each class is in one
cluster only, V is their harmonic mean (Rosenberg & Hirschberg 2007). The adjusted Rand index counts
pairs and is 0 for chance (Hubert & Arabie 1985). Sums are exact (`math.fsum`) or of integers, so
the order of things does not matter.
"""

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from projections.map.partitions import adjusted_rand_of_pairs
from projections.map.view import MapView

from .truth import Key, Truth

SPANS_FROM = 0.1
"""A place spans two rooms when a second room has at least this share of its members."""
BINS = 10
"""The number of bins of the confidence, for calibration."""


@dataclass(frozen=True, slots=True)
class ClusterScores:
    """Scores of a clustering; each is between 0 and 1, ``adjusted_rand`` may be below 0."""

    homogeneity: float
    completeness: float
    v_measure: float
    adjusted_rand: float


def agreement(classes: Sequence[Hashable], clusters: Sequence[Hashable]) -> ClusterScores:
    """Compare ``clusters`` with the true ``classes``; for no things at all everything is 1."""
    both = Counter(zip(classes, clusters, strict=True))
    by_class, by_cluster = Counter(classes), Counter(clusters)
    total = len(classes)
    h_class, h_cluster = _entropy(by_class, total), _entropy(by_cluster, total)
    mutual = h_class + h_cluster - _entropy(both, total)
    homogeneity = min(1.0, max(0.0, mutual / h_class)) if h_class else 1.0
    completeness = min(1.0, max(0.0, mutual / h_cluster)) if h_cluster else 1.0
    together = homogeneity + completeness
    v = 2.0 * homogeneity * completeness / together if together else 0.0
    return ClusterScores(
        homogeneity, completeness, v, _adjusted_rand(both, by_class, by_cluster, total)
    )


def _agreement(
    classes: Sequence[Hashable], clusters: Sequence[Hashable]
) -> dict[str, float | None]:
    """As JSON; all None for no things at all, of which nothing is known."""
    scores = asdict(agreement(classes, clusters))
    return scores if classes else dict.fromkeys(scores)


def _entropy(counts: Counter[Hashable] | Counter[tuple[Hashable, Hashable]], total: int) -> float:
    return -math.fsum(n / total * math.log(n / total) for n in counts.values())


def _adjusted_rand(
    both: Counter[tuple[Hashable, Hashable]],
    by_class: Counter[Hashable],
    by_cluster: Counter[Hashable],
    total: int,
) -> float:
    together, in_class, in_cluster = (
        sum(n * (n - 1) // 2 for n in counts.values()) for counts in (both, by_class, by_cluster)
    )
    pairs = total * (total - 1) // 2
    return float(adjusted_rand_of_pairs(pairs, together, in_class, in_cluster))


def place_scores(view: MapView, truth: Truth) -> dict[str, Any]:
    """Places against rooms, over placed keyframes whose room is known; None for scores of none."""
    known = [(k, truth.room((k.run_id, k.keyframe_id))) for k in view.keyframes]
    labelled = [(room, k.place) for k, room in known if room is not None]
    placed = [(room, place) for room, place in labelled if place is not None]
    scores = _agreement([room for room, _ in placed], [place for _, place in placed])
    posed = [k for k in view.keyframes if k.pose is not None]
    noise = sum(k.place is None for k in posed)
    spanning = sum(_spans(Counter(r for r, p in placed if p == place)) for place in view.places)
    return {
        "number": len(view.places),
        "rooms": len({room for room, _ in labelled}),
        "keyframes": len(placed),
        **scores,
        "noise_share": noise / len(posed) if posed else 0.0,
        "spanning_share": spanning / len(view.places) if view.places else 0.0,
    }


def _spans(rooms: Counter[str]) -> bool:
    counts = [n for _, n in rooms.most_common(2)]
    return len(counts) > 1 and counts[1] >= SPANS_FROM * rooms.total()


def object_scores(view: MapView, truth: Truth) -> dict[str, Any]:
    """Objects against instances, over fused observations whose instance is known.

    ``duplicates`` are Objects beyond the first of their instance, ``wrong_fusions`` Objects with
    observations of more than one instance, ``phantoms`` Objects of false positives alone. Scores of
    no observation are None.
    """
    seen = instances_of(view, truth)
    fused = [(i, view.observations[o].object) for o, i in seen if i is not None]
    pairs = [(instance, thing) for instance, thing in fused if thing is not None]
    scores = _agreement([instance for instance, _ in pairs], [thing for _, thing in pairs])
    of_thing: dict[int, Counter[str]] = {}
    for instance, thing in pairs:
        of_thing.setdefault(thing, Counter())[instance] += 1
    owners = Counter(max(sorted(c), key=c.__getitem__) for c in of_thing.values())
    return {
        "number": len(view.objects),
        "instances": len({instance for instance, _ in pairs}),
        "observations": len(pairs),
        **scores,
        "duplicates": sum(n - 1 for n in owners.values()),
        "wrong_fusions": sum(len(c) > 1 for c in of_thing.values()),
        "phantoms": len(view.objects) - len(of_thing),
    }


def instances_of(view: MapView, truth: Truth) -> Iterable[tuple[int, str | None]]:
    """(observation, true instance or None) of every observation whose keyframe has truth."""
    for keyframe in view.keyframes:
        key: Key = (keyframe.run_id, keyframe.keyframe_id)
        if key in truth.keyframes:
            for index, observation in enumerate(keyframe.observations):
                yield observation, truth.instance(key, index)


def expected_calibration_error(confidence: Sequence[float], right: Sequence[bool]) -> float:
    """The mean gap between confidence and share of right answers, over ten equal bins."""
    gaps = [
        abs(sum(confidence[i] for i in members) - sum(right[i] for i in members))
        for members in bins(confidence)
    ]
    return sum(gaps) / len(confidence) if confidence else 0.0


def calibration_floor(confidence: Sequence[float]) -> float:
    """The calibration error to expect if every confidence were the true probability.

    The number of right answers in a bin is a sum of independent Bernoulli variables; the mean gap
    to its expectation is computed from its distribution.
    """
    gaps = []
    for members in bins(confidence):
        chances = np.ones(1)
        for i in members:
            p = confidence[i]
            chances = np.append(chances * (1.0 - p), 0.0) + np.append(0.0, chances * p)
        expected = math.fsum(confidence[i] for i in members)
        off = np.abs(np.arange(len(chances)) - expected)
        gaps.append(math.fsum((chances * off).tolist()))  # not @, whose order BLAS chooses
    return math.fsum(gaps) / len(confidence) if confidence else 0.0


def reliability(confidence: Sequence[float], right: Sequence[bool]) -> list[dict[str, float]]:
    """Per bin that is not empty: how many, mean confidence, share right."""
    return [
        {
            "count": len(members),
            "confidence": sum(confidence[i] for i in members) / len(members),
            "right": sum(right[i] for i in members) / len(members),
        }
        for members in bins(confidence)
        if members
    ]


def bins(confidence: Sequence[float]) -> list[list[int]]:
    """Indices by confidence; 1.0 belongs to the last bin."""
    found: list[list[int]] = [[] for _ in range(BINS)]
    for index, value in enumerate(confidence):
        found[min(BINS - 1, int(value * BINS))].append(index)
    return found


def auroc(positive: Sequence[float], negative: Sequence[float]) -> float | None:
    """Chance that a positive scores above a negative, ties half; None if either is missing."""
    if not positive or not negative:
        return None
    ranked = sorted([(value, 1) for value in positive] + [(value, 0) for value in negative])
    above, start = 0.0, 0
    while start < len(ranked):
        end = start
        while end < len(ranked) and ranked[end][0] == ranked[start][0]:
            end += 1
        mean_rank = (start + 1 + end) / 2
        above += mean_rank * sum(kind for _, kind in ranked[start:end])
        start = end
    n = len(positive)
    return (above - n * (n + 1) / 2) / (n * len(negative))


def percentile(values: Sequence[float], share: float) -> float | None:
    """The ``share`` quantile (0 … 1) by linear interpolation; None for no values, and where it is
    infinite."""
    if not values:
        return None
    ordered = sorted(values)
    at = share * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1) if at > low else low
    if math.isinf(ordered[high]):
        return None
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])


def percentiles(values: Iterable[float | None]) -> dict[str, float | None]:
    """The median and the ninetieth percentile of the values that are there."""
    present = [value for value in values if value is not None]
    return {"p50": percentile(present, 0.5), "p90": percentile(present, 0.9)}


def share(holds: Iterable[bool]) -> float | None:
    """The share that holds; None of none."""
    every = list(holds)
    return sum(every) / len(every) if every else None
