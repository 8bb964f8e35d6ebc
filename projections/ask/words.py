"""What words mean in a map: classes by their names, and Objects by what they look like.

Classes are meant by these rules, of which the first that finds one counts:

1. ``exact``: the class's name, whatever its letter case and with an article or without; spaces,
   ``_`` and ``-`` are equal,
2. ``plural``: its plural, such as chairs, knives or people,
3. ``words``: every word asked for, or its plural, is a word of the class: table finds coffee table,
4. ``spelling``: the classes spelled most like it (`difflib`, ratio of `_LEAST_RATIO` or more).

A text encoder turns words into a vector of the space of the map's embeddings. A text is less like
every picture than pictures are like each other, by an amount that differs from text to text, so a
cosine says nothing by itself. The *score* of an Object is how far the cosine of the words with the
mean of its vectors is above the mean of all Objects of the map, in standard deviations: unlike a
rank it also says how much more the first is like the words than the next. What looks like the words
has at least half the score of the best. Words that are a class by the rules 1 to 3 mean the Objects
of it, and behind these others that look like the words at least as much as half of them do; other
words mean what looks like them.
"""

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from eventsrc.base.errors import MisuseError
from projections.fold.exact import Q40, quantise
from projections.map.records import ObjectRecord
from projections.map.view import MapView

ClassMatch = Literal["exact", "plural", "words", "spelling"]
"""The rule by which classes are what was asked for."""
MOST_CLASSES: Final = 5
"""Classes that are the nearest in spelling, at most."""

_LEAST_RATIO: Final = 0.75
_IRREGULAR: Final = {
    "person": "people",
    "man": "men",
    "woman": "women",
    "child": "children",
    "mouse": "mice",
    "foot": "feet",
    "tooth": "teeth",
    "knife": "knives",
    "shelf": "shelves",
    "bookshelf": "bookshelves",
    "loaf": "loaves",
    "leaf": "leaves",
    "scarf": "scarves",
}


def classes_meant(what: str, classes: Iterable[str]) -> tuple[ClassMatch, set[str]]:
    """The classes among some that a text means, and the rule by which; none for none."""
    asked = _plain(what)
    by_name: dict[str, set[str]] = {}
    for each in classes:
        by_name.setdefault(_plain(each), set()).add(each)
    if asked not in by_name:
        asked = re.sub("^(a|an|the) ", "", asked)
    if asked in by_name:
        return "exact", by_name[asked]
    plural = [name for name in by_name if asked in _plurals(name)]
    if plural:
        return "plural", _union(by_name, plural)
    words = [name for name in by_name if asked and _has_words(name, asked)]
    if words:
        return "words", _union(by_name, words)
    forms = {form: name for name in sorted(by_name) for form in (name, *_plurals(name))}
    near = difflib.get_close_matches(asked, forms, MOST_CLASSES, _LEAST_RATIO)
    if near:
        best = _ratio(asked, near[0])
        names = [forms[each] for each in near if _ratio(asked, each) == best]
        return "spelling", _union(by_name, names)
    return "spelling", set()


def _ratio(asked: str, form: str) -> float:
    return difflib.SequenceMatcher(None, form, asked).ratio()


def _union(by_name: Mapping[str, set[str]], names: Iterable[str]) -> set[str]:
    return set().union(*(by_name[name] for name in names))


def _plain(text: str) -> str:
    return " ".join(re.split(r"[\s_-]+", text.casefold())).strip()


def _plurals(name: str) -> set[str]:
    """The plurals of a class, of which the last word is one."""
    start, _, last = name.rpartition(" ")
    before = f"{start} " if start else ""
    forms = {f"{last}s", f"{last}es"}
    if last.endswith("y"):
        forms.add(f"{last[:-1]}ies")
    if last in _IRREGULAR:
        forms.add(_IRREGULAR[last])
    return {before + form for form in forms}


def _has_words(name: str, asked: str) -> bool:
    """Whether each word asked for is a word of a name, or the plural of one."""
    words = name.split()
    return all(any(word == w or word in _plurals(w) for w in words) for word in asked.split())


def near_classes(what: str, classes: Iterable[str]) -> list[str]:
    """The classes spelled most like what was asked for, for a message; none if none is like it."""
    return difflib.get_close_matches(_plain(what), sorted(classes), MOST_CLASSES, 0.5)


class NotComparedError(MisuseError):
    """Words cannot be compared with the map's embeddings; the message says why."""


class Words(Protocol):
    """A text encoder and the vectors of a map."""

    @property
    def model(self) -> str:
        """The space of the vectors, by its model's name. Raises NotComparedError."""

    def cosines(self, words: str) -> Mapping[str, float]:
        """The cosine of the words with each Object that has a vector, by its id. Raises
        NotComparedError, also for words that have no vector."""


@dataclass(frozen=True, slots=True)
class ObjectVectors:
    """The mean of the unit vectors of each Object of a map that has some, shape (objects, dim), and
    their space."""

    object_ids: tuple[str, ...]
    means: NDArray[np.float64]
    model: str | None

    @classmethod
    def of(cls, view: MapView) -> Self:
        """Those of a map with embeddings. Sums of whole numbers are exact, whatever adds them."""
        embedded = view.embedded()
        owners = [view.observations[number].object for number in embedded.tolist()]
        numbers = {ordinal: row for row, ordinal in enumerate(sorted({*owners} - {None}))}
        rows = np.array([numbers.get(each, -1) for each in owners], np.int64)
        order = np.argsort(rows, kind="stable")[np.count_nonzero(rows < 0) :]
        sums = np.zeros((len(numbers), 0))
        for start in range(0, len(order), _BLOCK):
            part = order[start : start + _BLOCK]
            vectors = view.vectors(embedded[part])
            if not start:
                sums = np.zeros((len(numbers), vectors.shape[1]))
            firsts = np.flatnonzero(np.diff(rows[part], prepend=-1))
            sums[rows[part][firsts]] += np.add.reduceat(vectors, firsts, axis=0, dtype=np.float64)
        counts = np.bincount(rows[order], minlength=len(numbers)).reshape(-1, 1)
        model = view.observations[int(embedded[0])].embedding_model if len(embedded) else None
        ids = tuple(view.all_objects[ordinal].object_id for ordinal in numbers)
        return cls(ids, sums / np.maximum(counts, 1), model)

    def cosines(self, vector: Sequence[float] | NDArray[np.float32]) -> dict[str, float]:
        """The cosine of a unit vector with each Object's mean vector, by its id."""
        asked = quantise(np.asarray(vector, np.float32)).astype(np.float64)
        lengths = np.sqrt(np.einsum("ij,ij->i", self.means, self.means)) * Q40**0.5
        found = self.means @ asked / np.maximum(lengths, 1.0)
        return dict(zip(self.object_ids, found.tolist(), strict=True))


_BLOCK: Final = 4096


def scores(cosines: Mapping[str, float]) -> dict[str, float]:
    """How far each cosine is above the mean of all, in standard deviations; to four digits."""
    values = np.array(list(cosines.values()))
    mean, spread = (values.mean(), values.std()) if len(values) else (0.0, 0.0)
    found = np.round((values - mean) / spread, 4) if spread > _LEAST_SPREAD else 0.0 * values
    return dict(zip(cosines, found.tolist(), strict=True))


_LEAST_SPREAD: Final = 1e-9


def looking_like(
    found: Mapping[str, float], standing: Sequence[ObjectRecord], classes: set[str]
) -> list[ObjectRecord]:
    """The Objects that look like words which gave them these scores, beside those of some
    classes."""
    least = max(found.values(), default=0.0) / 2
    own = [found[o.object_id] for o in standing if o.class_name in classes and o.object_id in found]
    if own:
        least = max(least, float(np.median(own)))
    return [
        each
        for each in standing
        if each.class_name not in classes
        and (score := found.get(each.object_id, 0.0)) > 0.0
        and score >= least
    ]
