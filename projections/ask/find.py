"""Where things are: the Objects of a map that a person asks for.

`find` is pure over a `MapView` and what `Words` of it answer. What is asked for is an Object's id,
nothing, which is everything, or words (`projections.ask.words`).

Answers of the classes meant come before those that only look like the words. Both are ordered by
way where ``start`` is given, by distance where ``near`` is; else those that are where they were
last seen come before those that are missing, then those with the best score where words were
compared with embeddings, then the ones seen most often.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Final, Literal, NamedTuple

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import advised, visible
from eventsrc.log.seek import time_of
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.fold.exact import UM_PER_M
from projections.map.naming import MOST_NEAR, Rule, Thing, Things, matches, thing_called, things_of
from projections.map.phrases import iso_time
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.state_output import space_advice
from projections.map.view import MapView

from .driven_ground import DrivenGround
from .words import (
    ClassMatch,
    NotComparedError,
    Words,
    classes_meant,
    looking_like,
    near_classes,
    scores,
)

Match = Literal["id", "everything", "look"] | ClassMatch
"""How an Object is what was asked for; ``look`` is by its embeddings alone."""

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
    before, in metres. ``offsets`` are the events that saw it. ``score`` is how much more it looks
    like the words than all Objects do, in standard deviations; None where that was not compared.
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
    score: float | None = None

    def __repr__(self) -> str:
        at = f"({self.x:.2f}, {self.y:.2f})"
        return f"<{visible(self.class_name)} {self.object_id} at {at}, seen {self.obs_count:,}×>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class FoundObjects:
    """The answers, best first, of ``count`` that there are; ``unconfirmed`` more were seen once.

    ``match`` is the rule by which ``classes`` are what was asked for. ``text_encoder`` is the model
    that compared the words with embeddings, None if none did; ``remark`` is then why, where that
    matters.
    """

    match: Match
    classes: tuple[str, ...]
    count: int
    unconfirmed: int
    answers: tuple[FoundObject, ...]
    text_encoder: str | None = None
    remark: str | None = None

    def __repr__(self) -> str:
        return f"<{len(self.answers):,} of {self.count:,} found: {list(self.answers[:3])}>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def find(view: MapView, wanted: Wanted, words: Words | None = None) -> FoundObjects:
    """The Objects of a map that answer a question; ``words`` compare its text with embeddings.

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
    meant = _meant(view, wanted.what, things, words)
    match, objects = meant.match, meant.objects
    since, before = _seconds(wanted.seen_since), _seconds(wanted.not_seen_since)
    objects = [o for o in objects if since is None or o.last_seen >= since]
    objects = [o for o in objects if before is None or o.last_seen < before]
    found = [each for each in objects if _is_wanted(each, wanted, room)]
    kept = found
    if match != "id" and not wanted.every:
        kept = [each for each in found if each.confirmed]

    way_to = {} if ways is None else {each.ordinal: ways.to(each) for each in kept}

    def order(each: ObjectRecord) -> tuple[bool, float, float, bool, float, int, int]:
        way = 0.0 if ways is None else way_to[each.ordinal]
        distance = 0.0 if spot is None else math.dist(each.spot, spot)
        return (
            each.class_name not in meant.classes,
            math.inf if way is None else way,
            distance,
            each.missing_in is not None,
            -meant.scores.get(each.object_id, 0.0),
            -each.obs_count,
            each.ordinal,
        )

    best = sorted(kept, key=order)[: wanted.top]
    answers = [
        replace(
            answer_of(view, each, match, spot, way_to.get(each.ordinal)),
            match=match if each.class_name in meant.classes else "look",
            score=meant.scores.get(each.object_id),
        )
        for each in best
    ]
    return FoundObjects(
        *(match, tuple(sorted(meant.classes)), len(kept), len(found) - len(kept), tuple(answers)),
        *(meant.text_encoder, meant.remark),
    )


def _seconds(time: float | str | None) -> float | None:
    """A time in seconds since the epoch. Raises MisuseError for a text that is not ISO 8601."""
    if not isinstance(time, str):
        return time
    time_ns = time_of(time)
    if time_ns is None:
        raise MisuseError(f"{time!r} is no time; give it with its date, as 2026-03-24T13:00:00Z")
    return time_ns / 1e9


class _Meant(NamedTuple):
    """The Objects that are what is asked for: by a rule those of some classes, and others that look
    like it."""

    match: Match
    objects: list[ObjectRecord]
    classes: set[str]
    scores: Mapping[str, float] = {}
    text_encoder: str | None = None
    remark: str | None = None


def _meant(view: MapView, what: str | None, things: Things, words: Words | None) -> _Meant:
    """What is asked for."""
    standing = list(view.objects.values())
    if what is None:
        return _Meant("everything", standing, {each.class_name for each in standing})
    shown = what if len(what) <= _MAX_SHOWN else f"{what[:_MAX_SHOWN]}…"  # no name is as long
    likely = things.likely(shown)
    rule, called = matches(shown, (thing for thing in likely if thing.kind == "object"))
    if rule in (Rule.ID, Rule.SHORT):
        one = thing_called(shown, called, ["object"])
        found = view.all_objects[view.object_survivors.find(ObjectOrdinal(one.ordinal))]
        return _Meant("id", [found], {found.class_name})
    match, classes = classes_meant(shown, {each.class_name for each in standing})
    of_class = [each for each in standing if each.class_name in classes]
    is_class = bool(classes) and match != "spelling"
    places = matches(shown, (thing for thing in likely if thing.kind == "place"))[1]
    remark = None if is_class else _NO_TEXT_ENCODER
    if words is not None and (is_class or not places):
        try:
            scored, model = scores(words.cosines(what)), words.model
        except NotComparedError as error:
            remark = str(error)
        else:
            kept = classes if is_class else set[str]()
            objects = [*(of_class if is_class else ()), *looking_like(scored, standing, kept)]
            return _Meant(match if is_class else "look", objects, kept, scored, model)
    if not classes:
        if not standing and not places:
            why = space_advice(view)
            raise MisuseError(f"no {shown!r}: this map has no Objects{f'; {why}' if why else ''}")
        raise _nothing(shown, standing, places, remark)
    return _Meant(match, of_class, classes, remark=remark)


_NO_TEXT_ENCODER: Final = "without a text encoder words are compared with names of classes only"


def _nothing(
    what: str, standing: list[ObjectRecord], places: list[Thing], remark: str | None
) -> MisuseError:
    """The error for a class that the map does not have."""
    if places:
        listed = ", ".join(str(place) for place in places[:MOST_NEAR])
        lists = visible(advised("find", "--in", what))
        return MisuseError(f"{what!r} is a place: {listed}; `{lists}` lists what is in it")
    classes = sorted({each.class_name for each in standing})
    near = near_classes(what, classes)
    listed = f"near it: {', '.join(near)}" if near else f"there are {', '.join(classes[:10])}"
    more = f" and {len(classes) - 10} more" if not near and len(classes) > 10 else ""
    return MisuseError(f"no class like {what!r} in this map; {listed}{more}; {remark}")


def point_of(text: str) -> tuple[float, float] | None:
    """The point ``X,Y``; None for other text."""
    point = _POINT.fullmatch(text)
    if point is None:
        return None
    x, y = float(point[1]), float(point[2])
    return (x, y) if math.isfinite(x) and math.isfinite(y) else None


def spot_of(near: str, things: Things) -> tuple[float, float]:
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
        self._view, self._ground = view, view.once(DrivenGround)
        node = self._ground.nearest(start)
        self._more = math.dist(self._ground.spots[node], start)
        self._lengths = self._ground.lengths_from(node)[0]

    def to(self, each: ObjectRecord) -> float | None:
        """The length of the way to an Object, in metres; None where there is none."""
        way = self._ground.way_m(each, self._view.seen_by(each), self._lengths)
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
