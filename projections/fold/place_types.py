"""Types of places: kitchen, office, bathroom …, from the classes of their Objects.

Naive Bayes over `place_type_table`: all types have the same prior, and each class in the place
contributes the ratio of its frequencies in rooms of each type. For n Objects of a class the ratio
is taken to the power √n, since six chairs are hardly more evidence than three; an Object that was
observed once is often a phantom or a wrong label and counts a quarter. Absent classes are no
evidence, since the robot may not have looked there. The sum is tempered by `_TEMPER`, and more
where there is more than `_MOST_WEIGHT` of it, because classes are not independent: this calibrates
the probabilities.

Below `UNSURE` the answer is unsure. A name given to the place by a command that has a type's name
in it ("kitchen", "2nd floor office") decides, whatever is in the place.

Everything is bit-exact: one order, +, −, ×, √ and `exact_functions`; probabilities are rounded to
three digits.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from .exact_functions import exp, log
from .place_type_table import NAMES, SYNONYMS, TABLE, TYPES

UNSURE: Final = 0.5
ONCE: Final = 0.25
"""The weight of an Object with one observation."""
_TEMPER: Final = 0.6
_MOST_WEIGHT: Final = 4.0
"""The greatest total weight of all classes: a place with everything is no room."""
_MOST_SHOWN: Final = 3
_LEAST_SHOWN: Final = 0.05


@dataclass(frozen=True, slots=True)
class PlaceType:
    """``type`` is None where it is unsure; ``probability`` is that of the likeliest one.
    ``candidates`` are the likeliest, at most three, with their probabilities. ``named`` is whether
    the place's name decided."""

    type: str | None
    probability: float
    candidates: tuple[tuple[str, float], ...]
    named: bool = False


def place_type(counts: Mapping[str, float], name: str | None = None) -> PlaceType | None:
    """The type of a place with these numbers of Objects of each class; None without evidence."""
    named = None if name is None else type_of_name(name)
    if named is not None:
        return PlaceType(named, 1.0, ((named, 1.0),), named=True)
    by_class: dict[str, float] = {}
    for class_name, count in counts.items():
        known = known_class(class_name)
        if known is not None and count > 0:
            by_class[known] = by_class.get(known, 0.0) + count
    if not by_class:
        return None
    scores, total = [0.0] * len(TYPES), 0.0
    for known in sorted(by_class):
        count = by_class[known]
        weight = count if count < 1.0 else math.sqrt(count)
        total += weight
        for number, ratio in enumerate(_LOGS[known]):
            scores[number] += weight * ratio
    temper = _TEMPER * min(1.0, _MOST_WEIGHT / total)
    return _answer([temper * score for score in scores])


def _answer(scores: list[float]) -> PlaceType:
    best = max(scores)
    odds = [exp(max(score - best, -40.0)) for score in scores]
    total = math.fsum(odds)
    ranked = sorted(
        ((round(each / total, 3), number) for number, each in enumerate(odds)),
        key=lambda pair: (-pair[0], pair[1]),
    )
    shown = tuple((TYPES[n], p) for p, n in ranked[:_MOST_SHOWN] if p >= _LEAST_SHOWN)
    probability, number = ranked[0]
    return PlaceType(TYPES[number] if probability >= UNSURE else None, probability, shown)


@lru_cache(maxsize=4096)
def known_class(class_name: str) -> str | None:
    """The table's name of a class; None for one that it does not have."""
    plain = " ".join(class_name.casefold().replace("_", " ").replace("-", " ").split())
    plain = SYNONYMS.get(plain, plain)
    return plain if plain in TABLE else None


@lru_cache(maxsize=4096)
def type_of_name(name: str) -> str | None:
    """The type in a place's name: of the types' names in it, also in the plural, the longest, of
    several of one length the first; None if there is none."""
    words = re.split(r"[^a-z]+", name.casefold())
    plain = f" {' '.join(words)} {' '.join(word.removesuffix('s') for word in words)} "
    found = [(-len(each), plain.index(f" {each} "), each) for each in NAMES if f" {each} " in plain]
    return NAMES[min(found)[2]] if found else None


_LOGS: Final[Mapping[str, tuple[float, ...]]] = {
    name: tuple(log(share) for share in shares) for name, shares in TABLE.items()
}
