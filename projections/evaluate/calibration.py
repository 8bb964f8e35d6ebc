"""Is a confidence of 0.8 right four times in five, and does it tell known from unknown?"""

from collections.abc import Sequence

BINS = 10


def expected_calibration_error(confidence: Sequence[float], right: Sequence[bool]) -> float:
    """The mean gap between confidence and share of right answers, over ten equal bins."""
    gaps = [
        abs(sum(confidence[i] for i in members) - sum(right[i] for i in members))
        for members in bins(confidence)
    ]
    return sum(gaps) / len(confidence) if confidence else 0.0


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
    """The ``share`` quantile (0 … 1) by linear interpolation; None for no values."""
    if not values:
        return None
    ordered = sorted(values)
    at = share * (len(ordered) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])
