"""Where things are: the Objects of a map that a person asks for.

`find` is pure over a `MapView`. What is asked for is an Object's id, nothing, which is everything,
or classes by these rules, of which the first that finds one counts:

1. ``exact``: the class's name, whatever its letter case and with an article or without; spaces,
   ``_`` and ``-`` are equal,
2. ``plural``: its plural, such as chairs, knives or people,
3. ``words``: every word asked for, or its plural, is a word of the class: table finds coffee table,
4. ``spelling``: the classes spelled most like it (`difflib`, ratio of `_LEAST_RATIO` or more).

Answers are ordered by way where ``start`` is given, by distance where ``near`` is; else those that
are where they were last seen come before those that are missing, then the ones seen most often.
"""

import difflib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, visible
from eventsrc.log.seek import time_of
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.exact import UM_PER_M
from projections.map.naming import MOST_NEAR, Rule, Thing, matches, thing_called, things_of
from projections.map.phrases import iso_time
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.view import MapView

from .driven_ground import DrivenGround

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


Match = Literal["id", "everything"] | ClassMatch
"""How an Object is what was asked for."""

_MAX_SHOWN: Final = 256
_NUMBER: Final = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_POINT: Final = re.compile(rf"\s*({_NUMBER})\s*,\s*({_NUMBER})\s*")


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """What is asked for.

    ``what`` is None for everything. ``room`` is the Place that it is in, ``near`` a point ``X,Y``
    in metres, or an Object or Place, by any of its names; so is ``start``, from which the way over
    driven ground counts instead of the straight line. Times are ISO 8601, or robot seconds since
    the epoch: last seen at ``seen_since`` or later, and before ``not_seen_since``. There are at
    most ``top`` answers, Objects that were seen once among them only with ``every``.
    """

    what: str | None = None
    room: str | None = None
    near: str | None = None
    start: str | None = None
    missing: bool = False
    moved: bool = False
    seen_since: float | str | None = None
    not_seen_since: float | str | None = None
    top: int = 10
    every: bool = False


@dataclass(frozen=True, slots=True)
class SeenAt:
    """The keyframe in which a thing was seen, with the offset of its event. ``time`` is in robot
    seconds since the epoch, ``iso`` the same as ISO 8601."""

    time: float
    iso: str
    run_id: str
    keyframe_id: int
    offset: int


@dataclass(frozen=True, slots=True)
class FoundObject:
    """An Object that answers a question.

    ``x`` and ``y`` are metres; ``sigma_m`` is their standard error in the direction in which it is
    largest, None where they are the mean position of the robot that saw it. ``distance_m`` is from
    what it should be near, ``way_m`` the way to it over driven ground, None for none.
    ``missing_in`` is the run that should have seen it and did not, ``moved_from`` where it stood
    before, in metres. ``offsets`` are the events that saw it.
    """

    object_id: str
    class_name: str
    match: Match
    place_id: str | None
    place_name: str | None
    place_type: str | None
    x: float
    y: float
    sigma_m: float | None
    distance_m: float | None
    way_m: float | None
    obs_count: int
    confirmed: bool
    first_seen: SeenAt
    last_seen: SeenAt
    missing_in: str | None
    moved_from: tuple[float, float] | None
    offsets: tuple[int, ...]

    def __repr__(self) -> str:
        at = f"({self.x:.2f}, {self.y:.2f})"
        return f"<{visible(self.class_name)} {self.object_id} at {at}, seen {self.obs_count:,}×>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class FoundObjects:
    """The answers, best first, of ``count`` that there are; ``unconfirmed`` more were seen once.

    ``match`` is the rule by which ``classes`` are what was asked for.
    """

    match: Match
    classes: tuple[str, ...]
    count: int
    unconfirmed: int
    answers: tuple[FoundObject, ...]

    def __repr__(self) -> str:
        return f"<{len(self.answers):,} of {self.count:,} found: {list(self.answers[:3])}>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def find(view: MapView, wanted: Wanted) -> FoundObjects:
    """The Objects of a map that answer a question.

    Raises MisuseError, also NoSuchThing and SeveralThings, for what the map does not have or what
    means several things, and for a question that its settings cannot answer.
    """
    if (wanted.missing or wanted.moved) and view.settings.fusion != "evidence":
        raise MisuseError(
            "only a map with fusion by evidence knows what is missing or has moved; fold it with"
            " --preset full"
        )
    things = things_of(view)
    room = None
    if wanted.room is not None:
        ordinal = PlaceOrdinal(thing_called(wanted.room, things, ["place"]).ordinal)
        room = view.survivors.find(ordinal)
    spot = None if wanted.near is None else spot_of(wanted.near, things)
    ways = None if wanted.start is None else _Ways(view, spot_of(wanted.start, things))
    match, objects = _meant(view, wanted.what, things)
    classes = tuple(sorted({each.class_name for each in objects}))
    since, before = _seconds(wanted.seen_since), _seconds(wanted.not_seen_since)
    objects = [o for o in objects if since is None or o.last_seen >= since]
    objects = [o for o in objects if before is None or o.last_seen < before]
    found = [each for each in objects if _is_wanted(each, wanted, room)]
    kept = found
    if match != "id" and not wanted.every:
        kept = [each for each in found if each.confirmed]

    way_to = {} if ways is None else {each.ordinal: ways.to(each) for each in kept}

    def order(each: ObjectRecord) -> tuple[float, float, bool, int, int]:
        way = 0.0 if ways is None else way_to[each.ordinal]
        distance = 0.0 if spot is None else math.dist(each.spot, spot)
        return (
            math.inf if way is None else way,
            distance,
            each.missing_in is not None,
            -each.obs_count,
            each.ordinal,
        )

    best = sorted(kept, key=order)[: wanted.top]
    answers = [answer_of(view, each, match, spot, way_to.get(each.ordinal)) for each in best]
    return FoundObjects(match, classes, len(kept), len(found) - len(kept), tuple(answers))


def _seconds(time: float | str | None) -> float | None:
    """A time in seconds since the epoch. Raises MisuseError for a text that is not ISO 8601."""
    if not isinstance(time, str):
        return time
    time_ns = time_of(time)
    if time_ns is None:
        raise MisuseError(f"{time!r} is no time; give it with its date, as 2026-03-24T13:00:00Z")
    return time_ns / 1e9


def _meant(
    view: MapView, what: str | None, things: list[Thing]
) -> tuple[Match, list[ObjectRecord]]:
    """The Objects that are what is asked for, and the rule by which."""
    standing = list(view.objects.values())
    if what is None:
        return "everything", standing
    what = what if len(what) <= _MAX_SHOWN else f"{what[:_MAX_SHOWN]}…"  # no name is as long
    rule, called = matches(what, (thing for thing in things if thing.kind == "object"))
    if rule in (Rule.ID, Rule.SHORT):
        one = thing_called(what, called, ["object"])
        found = view.object_survivors.find(ObjectOrdinal(one.ordinal))
        return "id", [view.all_objects[found]]
    match, classes = classes_meant(what, {each.class_name for each in standing})
    if not classes:
        raise _nothing(what, standing, things)
    return match, [each for each in standing if each.class_name in classes]


def _nothing(what: str, standing: list[ObjectRecord], things: list[Thing]) -> MisuseError:
    """The error for a class that the map does not have."""
    places = matches(what, (thing for thing in things if thing.kind == "place"))[1]
    if places:
        listed = ", ".join(str(place) for place in places[:MOST_NEAR])
        lists = visible(advised("find", "--in", what))
        return MisuseError(f"{what!r} is a place: {listed}; `{lists}` lists what is in it")
    classes = sorted({each.class_name for each in standing})
    if not classes:
        return MisuseError(f"no {what!r}: this map has no Objects")
    near = near_classes(what, classes)
    listed = f"near it: {', '.join(near)}" if near else f"there are {', '.join(classes[:10])}"
    more = f" and {len(classes) - 10} more" if not near and len(classes) > 10 else ""
    return MisuseError(f"no class like {what!r} in this map; {listed}{more}")


def point_of(text: str) -> tuple[float, float] | None:
    """The point ``X,Y``; None for other text."""
    point = _POINT.fullmatch(text)
    if point is None:
        return None
    x, y = float(point[1]), float(point[2])
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def spot_of(near: str, things: list[Thing]) -> tuple[float, float]:
    """The point that a text means, in metres: ``X,Y``, or an Object or a Place. Raises MisuseError,
    also NoSuchThing and SeveralThings."""
    point = point_of(near)
    if point is not None:
        return point
    thing = thing_called(near, things, ["place", "object"])
    if thing.spot is None:
        raise MisuseError(f"{near!r} has no position in this map; give X,Y in metres")
    return thing.spot


def _is_wanted(each: ObjectRecord, wanted: Wanted, room: PlaceOrdinal | None) -> bool:
    if room is not None and each.place != room:
        return False
    if wanted.missing and each.missing_in is None:
        return False
    return not wanted.moved or bool(each.relocations)


class _Ways:
    """Ways over driven ground from a spot."""

    def __init__(self, view: MapView, start: tuple[float, float]) -> None:
        self._ground = DrivenGround(view)
        node = self._ground.nearest(start)
        self._more = math.dist(self._ground.spots[node], start)
        self._lengths = self._ground.lengths_from(node)[0]

    def to(self, each: ObjectRecord) -> float | None:
        """The length of the way to an Object, in metres; None where there is none."""
        way = self._ground.way_m(each, self._lengths)
        return None if way is None else self._more + way


def answer_of(
    view: MapView,
    each: ObjectRecord,
    match: Match,
    spot: tuple[float, float] | None = None,
    way_m: float | None = None,
) -> FoundObject:
    """An Object as an answer."""
    at, place = each.estimate, each.place
    x, y = each.spot
    keyframes = view.sightings(each)
    kind = None if place is None else view.type_of(place)
    moved = each.relocations[-1] if each.relocations else None
    return FoundObject(
        object_id=each.object_id,
        class_name=each.class_name,
        match=match,
        place_id=view.place_id(place),
        place_name=None if place is None else view.all_places[place].name,
        place_type=None if kind is None else kind.type,
        x=x,
        y=y,
        sigma_m=None if at is None else at.est_sigma_m,
        distance_m=None if spot is None else math.dist(each.spot, spot),
        way_m=way_m,
        obs_count=each.obs_count,
        confirmed=each.confirmed,
        first_seen=seen_at(min(keyframes, key=_time)),
        last_seen=seen_at(max(keyframes, key=_time)),
        missing_in=None if each.missing_in is None else view.runs[each.missing_in].run_id,
        moved_from=(
            None if moved is None else (moved.from_x_um / UM_PER_M, moved.from_y_um / UM_PER_M)
        ),
        offsets=tuple(sorted({keyframe.offset for keyframe in keyframes})),
    )


def _time(keyframe: KeyframeRecord) -> tuple[float, int]:
    return keyframe.timestamp, keyframe.offset


def seen_at(keyframe: KeyframeRecord) -> SeenAt:
    """That a keyframe saw a thing."""
    time = keyframe.timestamp
    return SeenAt(time, iso_time(time), keyframe.run_id, keyframe.keyframe_id, keyframe.offset)
