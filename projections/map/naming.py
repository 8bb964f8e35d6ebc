"""What a person may call a Place or an Object, and how short its id is printed.

`matches` goes through these rules and takes the first that finds something:

1. the whole id,
2. a name that ``edit name-place`` gave,
3. a short id: ``p3`` of a Place; of an Object six or more of the first hexadecimal digits, with or
   without ``obj-``,
4. of a Place the type of room that it is,
5. of an Object its class.

So no name hides an id. Letter case matters in ids only; where a name, type or class is written
exactly as asked, others that differ in case do not count. Things that were merged into others have
their ids only, and a short id means one of them only if it means none that stands; one that only
comes later, only if it means none of these.
"""

import difflib
import re
from bisect import bisect_left
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from itertools import pairwise
from typing import Final, Literal

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, counted, visible
from projections.fold.place_types import NAMES

from .view import MapView

MOST_LISTED: Final = 10
"""Things that an error message lists, of those that a text may mean."""
MOST_NEAR: Final = 5
"""Names that an error message lists, of those that a text does not mean."""
LEAST_DIGITS: Final = 6
"""Hexadecimal digits of the shortest short id of an Object."""

_PLACE_NUMBER = re.compile(r".*_(p[0-9]+)", re.DOTALL)
_IDS_IN_TEXT = re.compile(
    r"""
    "[^"\n]*"  # a name, which stays as it is
    | (?<![\w/.:-]) obj-[0-9a-f]+ (?![\w/-])
    | _ (p[0-9]+) (?! [\w/-] | :[0-9] | \.\w )  # no run, keyframe, detection or file
    """,
    re.VERBOSE,
)
_INSIDE_A_WORD = re.compile(r"[\w/.:-]")
_DIGITS = re.compile(rf"(?:obj-)?([0-9a-f]{{{LEAST_DIGITS},}})")

Kind = Literal["place", "object"]


class Rule(IntEnum):
    """The rules by which a text means a thing, the first one first."""

    ID = 1
    NAME = 2
    SHORT = 3
    TYPE = 4
    CLASS = 5


class Existence(IntEnum):
    """Whether a thing stands in a map, was merged into another, or comes later."""

    STANDS = 0
    MERGED = 1
    LATER = 2


@dataclass(frozen=True, slots=True)
class Thing:
    """A Place or an Object by what it may be called. ``word`` is its type or class, ``name`` what a
    command called it, ``fate`` what became of one that does not stand. ``count`` are its keyframes
    or sightings; ``spot`` is in metres; ``place`` an Object's."""

    kind: Kind
    ordinal: int
    id: str
    word: str | None = None
    name: str | None = None
    existence: Existence = Existence.STANDS
    count: int = 0
    spot: tuple[float, float] | None = None
    place: str | None = None
    fate: str | None = None

    @property
    def stands(self) -> bool:
        """Whether it is in the map."""
        return self.existence is Existence.STANDS

    def __str__(self) -> str:
        """The id and what tells it apart: ``run_p3 (kitchen, 12 keyframes at (1.20, 3.40))``."""
        parts = [] if self.word is None else [visible(self.word)]
        parts += [] if self.name is None else [f'"{visible(self.name)}"']
        parts += [] if self.place is None else [f"in {visible(self.place)}"]
        if self.spot is not None:
            of_place = self.kind == "place"
            seen = counted(self.count, "keyframe" if of_place else "time")
            at = f"at ({self.spot[0]:.2f}, {self.spot[1]:.2f})"
            parts.append(f"{seen} {at}" if of_place else f"seen {seen} {at}")
        parts += [] if self.fate is None else [visible(self.fate)]
        return f"{visible(self.id)} ({', '.join(parts)})" if parts else visible(self.id)


class NoSuchThing(MisuseError):
    """No thing of this name is in the map or its history; the message lists the nearest names.

    Places and objects depend on the settings, keyframes, runs and classes on the log alone.
    ``also`` are further spellings that may be near.
    """

    def __init__(
        self, kind: str, text: str, names: Iterable[str], also: Iterable[str] = (), advice: str = ""
    ) -> None:
        depends = kind in ("place", "object", "place or object")
        where = "under these settings" if depends else "in this log"
        near = _nearest(kind, text, list(names), list(also))
        super().__init__(f"no {kind} {text!r} {where}; {near}{advice}")


class SeveralThings(MisuseError):
    """A text means several Places or Objects; the message lists them, one a line."""

    def __init__(self, text: str, found: Sequence[Thing]) -> None:
        listed = "".join(f"\n  {thing}" for thing in found[:MOST_LISTED])
        more = len(found) - MOST_LISTED
        rest = f"\n  and {more:,} more" if more > 0 else ""
        kinds = {thing.kind for thing in found}
        what = counted(len(found), kinds.pop() if len(kinds) == 1 else "thing")
        super().__init__(f"{text!r} means {what}; give the id of one:{listed}{rest}")


def matches(text: str, things: Iterable[Thing]) -> tuple[Rule | None, list[Thing]]:
    """The things that a text means, in their order, and the rule by which; None for none."""
    found: dict[tuple[Rule, bool, Existence], list[Thing]] = {}
    folded = text.casefold()
    room = NAMES.get(folded)
    digits = _DIGITS.fullmatch(text)
    start = "" if digits is None else f"obj-{digits[1]}"

    def rank(thing: Thing) -> tuple[Rule, bool, Existence] | None:
        """The rule, then what comes later among what it finds: the other case, the merged."""
        name, word, is_place = thing.name, thing.word, thing.kind == "place"
        if thing.id == text:
            return Rule.ID, False, Existence.STANDS
        if name is not None and thing.stands and name.casefold() == folded:
            return Rule.NAME, name != text, thing.existence
        if _place_number(thing.id) == text if is_place else start and thing.id.startswith(start):
            return Rule.SHORT, False, thing.existence
        if word is None or not thing.stands:
            return None
        if is_place:
            return (Rule.TYPE, False, thing.existence) if word in (room, folded) else None
        same = word.casefold() == folded
        return (Rule.CLASS, word != text, thing.existence) if same else None

    for thing in things:
        ranked = rank(thing)
        if ranked is not None:
            found.setdefault(ranked, []).append(thing)
    if not found:
        return None, []
    best = min(found)
    return best[0], found[best]


class Things(Iterable[Thing]):
    """Things, of which `likely` finds those that a text may mean without going through all."""

    def __init__(self, things: Iterable[Thing]) -> None:
        self._all = tuple(things)

    def __iter__(self) -> Iterator[Thing]:
        return iter(self._all)

    def likely(self, text: str) -> list[Thing]:
        """All things that the rules of `matches` may find, in their order."""
        folded, found = text.casefold(), set[int]()
        for key in {text, folded, NAMES.get(folded)}:
            found.update(self._called.get(key, ()))
        digits = _DIGITS.fullmatch(text)
        if digits is not None:
            start = f"obj-{digits[1]}"
            at = bisect_left(self._ids, (start, 0))
            while at < len(self._ids) and self._ids[at][0].startswith(start):
                found.add(self._ids[at][1])
                at += 1
        return [self._all[number] for number in sorted(found)]

    @cached_property
    def _ids(self) -> list[tuple[str, int]]:
        return sorted((thing.id, number) for number, thing in enumerate(self._all))

    @cached_property
    def _called(self) -> dict[str | None, list[int]]:
        """The things by what each may be called, but for beginnings of ids."""
        found: dict[str | None, list[int]] = {}
        for number, thing in enumerate(self._all):
            words = (each for each in (thing.name, thing.word) if each is not None)
            keys = {thing.id, *(word.casefold() for word in words)}
            if thing.kind == "place":
                keys.add(_place_number(thing.id) or thing.id)
            for key in keys:
                found.setdefault(key, []).append(number)
        return found


def thing_called(text: str, things: Iterable[Thing], kinds: Sequence[Kind]) -> Thing:
    """The one thing of these kinds that a text means. Raises NoSuchThing and SeveralThings."""
    likely = things.likely(text) if isinstance(things, Things) else things
    found = matches(text, (thing for thing in likely if thing.kind in kinds))[1]
    if len(found) == 1:
        return found[0]
    if found:
        raise SeveralThings(text, found)
    raise no_such_thing(text, things, kinds)


def no_such_thing(text: str, things: Iterable[Thing], kinds: Sequence[Kind]) -> NoSuchThing:
    """The error for a text that means none of these things."""
    if len(kinds) > 1 and text.startswith("obj-"):
        kinds = ["object"]
    own = [thing for thing in things if thing.kind in kinds]
    short = ShortIds.of(own)
    also = [short(thing.id) for thing in own]
    also += [w for thing in own if thing.stands for w in (thing.name, thing.word) if w is not None]
    lists = visible(advised("state", *(() if "place" in kinds else ("--json",))))
    advice = f"; `{lists}` lists them" if own else ""
    ids = [thing.id for thing in own]
    return NoSuchThing(" or ".join(kinds), text, ids, dict.fromkeys(also), advice)


def things_of(view: MapView) -> Things:
    """The Places and Objects of a map, also those that were merged into others, Places first."""
    return view.once(_things_of)


def _things_of(view: MapView) -> Things:
    found = []
    for place in view.all_places:
        stands = place.ordinal in view.places
        kind = view.type_of(place.ordinal) if stands else None
        found.append(
            Thing(
                "place",
                place.ordinal,
                place.place_id,
                None if kind is None else kind.type,
                place.name,
                Existence.STANDS if stands else Existence.MERGED,
                place.keyframe_count,
                (place.centroid_x, place.centroid_y) if place.keyframe_count else None,
                fate=None if stands else _merged(view.place_id(view.survivors.find(place.ordinal))),
            )
        )
    for each in view.all_objects:
        stands = each.ordinal in view.objects
        survivor = view.all_objects[view.object_survivors.find(each.ordinal)]
        found.append(
            Thing(
                "object",
                each.ordinal,
                each.object_id,
                each.class_name,
                existence=Existence.STANDS if stands else Existence.MERGED,
                count=each.obs_count,
                spot=each.spot if each.obs_count else None,
                place=view.place_id(each.place),
                fate=None if stands else _merged(survivor.object_id),
            )
        )
    return Things(found)


def _merged(into: str | None) -> str:
    return f"merged into {into}"


class ShortIds:
    """The shortest form of each id that `matches` takes for it alone among all of these: ``p3``,
    and of an Object ``obj-`` with six digits or more; the whole id where there is none."""

    def __init__(self, places: Iterable[str], objects: Iterable[str], names: Iterable[str]) -> None:
        given = {name.casefold() for name in names}
        numbers = {place: _place_number(place) for place in places}
        used = Counter(numbers.values())
        short = {place: n for place, n in numbers.items() if n is not None and used[n] == 1}
        short |= _beginnings(sorted(set(objects)))
        self._short = {whole: part for whole, part in short.items() if part not in given}
        self._shown = {visible(whole): part for whole, part in self._short.items()}
        self._numbered = {part: whole for whole, part in self._shown.items()}

    @classmethod
    def of(cls, things: Iterable[Thing]) -> "ShortIds":
        """Those of some things."""
        return cls(
            [thing.id for thing in things if thing.kind == "place"],
            [thing.id for thing in things if thing.kind == "object"],
            [thing.name for thing in things if thing.name is not None],
        )

    def __call__(self, whole: str) -> str:
        """The short form of an id; other texts as they are."""
        return self._short.get(whole, whole)

    def text(self, text: str) -> str:
        """A text with the short form of each id in it, but not between double quotes. Ids that are
        part of other words stay: of detections, keyframes, files."""
        parts: list[str] = []
        done = 0
        for found in _IDS_IN_TEXT.finditer(text):
            whole = found[0] if found[1] is None else self._numbered.get(found[1], "")
            start = found.end() - len(whole)
            if (
                whole not in self._shown
                or start < done
                or not text.startswith(whole, start)
                or _INSIDE_A_WORD.match(text[start - 1 : start])
            ):
                continue
            parts += (text[done:start], self._shown[whole])
            done = found.end()
        return "".join([*parts, text[done:]])


def _place_number(place_id: str) -> str | None:
    """``p3`` of ``run_p3``."""
    found = _PLACE_NUMBER.fullmatch(place_id)
    return None if found is None else found[1]


def _beginnings(ids: list[str]) -> dict[str, str]:
    """For each of some sorted Object ids as many of its digits as tell it from its neighbours."""
    least = len("obj-") + LEAST_DIGITS
    shared = [_shared(*pair) for pair in pairwise(ids)]
    lengths = [max(least, 1 + max(both)) for both in zip([0, *shared], [*shared, 0], strict=True)]
    pairs = zip(ids, lengths, strict=False)  # none of no ids
    return {whole: whole[:n] for whole, n in pairs if _DIGITS.fullmatch(whole[:n])}


def _shared(one: str, other: str) -> int:
    """The number of characters with which both begin."""
    pairs = enumerate(zip(one, other, strict=False))
    return next((n for n, (a, b) in pairs if a != b), min(len(one), len(other)))


def _nearest(kind: str, text: str, names: list[str], also: list[str]) -> str:
    if not names:
        return f"there is no {kind} at all"
    spelled = [*names, *also]
    near = _near_numbers(text, spelled) or difflib.get_close_matches(text, spelled, MOST_NEAR, 0.6)
    if near:
        return f"near it: {', '.join(map(visible, near))}"
    more = f" and {len(names) - MOST_NEAR} more" if len(names) > MOST_NEAR else ""
    return f"there are {', '.join(map(visible, names[:MOST_NEAR]))}{more}"


def _near_numbers(text: str, names: list[str]) -> list[str]:
    """Names equal but for their last number, the nearest numbers first: house-a:913 → :912."""
    stem, number = _split_number(text)
    if number is None:
        return []
    same_stem = [
        (abs(n - number), name)
        for name in names
        for s, n in [_split_number(name)]
        if s == stem and n is not None
    ]
    return [name for _, name in sorted(same_stem)[:MOST_NEAR]]


def _split_number(text: str) -> tuple[str, int | None]:
    """``house-a:913`` → ``house-a:``, 913; None for a text that ends with no number."""
    match = re.fullmatch(r"(.*?)(\d{1,18})", text, re.DOTALL)
    return (match[1], int(match[2])) if match else (text, None)
