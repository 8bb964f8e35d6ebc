"""How well two labellings agree: homogeneity, completeness, V, adjusted Rand.

Homogeneity is 1 when each cluster holds one class only, completeness when each class is in one
cluster only, V is their harmonic mean (Rosenberg & Hirschberg 2007). The adjusted Rand index counts
pairs and is 0 for chance (Hubert & Arabie 1985). Sums are exact (`math.fsum`) or of integers, so
the order of things does not matter.
"""

import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

from projections.partitions import adjusted_rand_of_pairs


@dataclass(frozen=True, slots=True)
class Agreement:
    """Each between 0 and 1, ``adjusted_rand`` also below 0."""

    homogeneity: float
    completeness: float
    v_measure: float
    adjusted_rand: float


def agreement(classes: Sequence[Hashable], clusters: Sequence[Hashable]) -> Agreement:
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
    return Agreement(
        homogeneity, completeness, v, _adjusted_rand(both, by_class, by_cluster, total)
    )


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
