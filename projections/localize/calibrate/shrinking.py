"""Shrinkage: a constant read off a map, drawn towards its prior when few observations back it."""

import math
from dataclasses import dataclass

PRIOR_COUNT = 100
"""The number of observations that a prior weighs as much as: a reading of n has the weight n/(n +
100)."""
_DIGITS = 4
_LEAST = 0.001
"""The least errors and spreads: no map is better than a millimetre or a milliradian."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A constant estimated from a map.

    ``value`` is the estimate to use, ``seen`` that of the map alone (None without evidence),
    ``prior`` the usual value, ``count`` the number of observations or pairs behind it.
    """

    name: str
    value: float | str | None
    seen: float | str | None
    prior: float | str | None
    count: int


def spread(name: str, seen: float, prior: float, count: int) -> Reading:
    """A reading of a quantity that is above 0: its logarithm is drawn towards the prior's."""
    if not count or not (math.isfinite(seen) and seen > 0.0):
        return unread(name, prior)
    share = count / (count + PRIOR_COUNT)
    value = math.exp(share * math.log(seen) + (1.0 - share) * math.log(prior))
    return Reading(name, max(rounded(value), _LEAST), rounded(seen), prior, count)


def level(name: str, seen: float, prior: float, count: int) -> Reading:
    """A reading of a quantity that may be negative."""
    if not count or not math.isfinite(seen):
        return unread(name, prior)
    share = count / (count + PRIOR_COUNT)
    value = share * seen + (1.0 - share) * prior
    return Reading(name, rounded(value), rounded(seen), prior, count)


def unread(name: str, prior: float | str | None) -> Reading:
    """The reading of a constant without evidence: the prior."""
    return Reading(name, prior, None, prior, 0)


def rounded(value: float) -> float:
    """Four significant digits, at most four decimals: machines whose logarithms differ in the last
    bit agree."""
    if value == 0.0:
        return 0.0
    decimals = _DIGITS - 1 - math.floor(math.log10(abs(value)))
    return round(value, max(0, min(decimals, _DIGITS))) + 0.0
