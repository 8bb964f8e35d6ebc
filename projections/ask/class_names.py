"""The classes of a map that a person means, by these rules; the first that finds one counts:

1. ``exact``: the class's name, whatever its letter case and with an article or without; spaces,
   ``_`` and ``-`` are equal,
2. ``plural``: its plural, such as chairs, knives or people,
3. ``words``: every word asked for, or its plural, is a word of the class: table finds coffee table,
4. ``spelling``: the classes spelled most like it (`difflib`, ratio of `_LEAST_RATIO` or more).
"""

import difflib
import re
from collections.abc import Iterable, Mapping
from typing import Final, Literal

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
