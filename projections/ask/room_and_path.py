"""What a room is and holds, and the way from one thing to another."""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from projections.fold.deltas import ObjectOrdinal, PlaceOrdinal
from projections.map.naming import Thing, matches, thing_called, things_of
from projections.map.place_regions import place_regions
from projections.map.records import KeyframeRecord, ObjectRecord
from projections.map.view import MapView

from .driven_ground import STEP_M, DrivenGround, Spot
from .find import FoundObject, SeenAt, answer_of, point_of, seen_at
from .goal_pose import CLEARANCE_M, GoalGround, GoalPose


@dataclass(frozen=True, slots=True)
class NamedPlace:
    """A Place by its id, the name that it was given, and the type of room that it is, if sure."""

    place_id: str
    name: str | None
    type: str | None


@dataclass(frozen=True, slots=True)
class NextRoom(NamedPlace):
    """A neighbour, and how often robots went there and back."""

    shared_transitions: int


@dataclass(frozen=True, slots=True)
class VisitedPlace(NamedPlace):
    """A Place and when robots were there, metres of the map frame."""

    type_probability: float | None
    floor: str | None
    centroid_x: float
    centroid_y: float
    area_m2: float | None
    keyframe_count: int
    first_visited: SeenAt
    last_visited: SeenAt


@dataclass(frozen=True, slots=True)
class ListedRoom(VisitedPlace):
    """A Place with how many confirmed and how many other Objects are in it."""

    objects: int
    unconfirmed: int

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def rooms(view: MapView) -> list[ListedRoom]:
    """The Places of a map, those with most keyframes first."""
    inside = Counter((each.place, each.confirmed) for each in view.objects.values())
    listed = [
        ListedRoom(
            **_visited(view, place), objects=inside[place, True], unconfirmed=inside[place, False]
        )
        for place in view.places
    ]
    return sorted(listed, key=lambda each: -each.keyframe_count)


@dataclass(frozen=True, slots=True)
class Room(VisitedPlace):
    """A Place. ``objects`` are the confirmed ones, those seen most often first, ``unconfirmed`` the
    number of others."""

    neighbours: tuple[NextRoom, ...]
    objects: tuple[FoundObject, ...]
    unconfirmed: int

    def __repr__(self) -> str:
        word = self.name or self.type
        called = visible(self.place_id if word is None else f"{self.place_id} {word}")
        return f"<{called}: {len(self.objects):,} objects, {len(self.neighbours):,} neighbours>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


def room(view: MapView, name: str) -> Room:
    """The Place that a text names. Raises NoSuchThing and SeveralThings."""
    meant = thing_called(name, things_of(view), ["place"])
    place = view.survivors.find(PlaceOrdinal(meant.ordinal))
    beside = {b if a == place else a: n for a, b, n in view.edges() if place in (a, b)}
    inside = [each for each in view.objects.values() if each.place == place]
    inside.sort(key=lambda each: (each.missing_in is not None, -each.obs_count, each.ordinal))
    kept = [each for each in inside if each.confirmed]
    return Room(
        **_visited(view, place),
        neighbours=tuple(
            NextRoom(**asdict(_named(view, other)), shared_transitions=n)
            for other, n in sorted(beside.items(), key=lambda item: (-item[1], item[0]))
        ),
        objects=tuple(answer_of(view, each, "everything") for each in kept),
        unconfirmed=len(inside) - len(kept),
    )


@dataclass(frozen=True, slots=True)
class Door:
    """Where a way goes from one Place to the next: between two poses, in metres."""

    x: float
    y: float
    before: str
    after: str


@dataclass(frozen=True, slots=True)
class DrivenPath:
    """A way over driven ground: its length and way points, the Places on it and the passages from
    one to the next. ``start`` and ``end`` are what was asked for; ``goal`` is the pose at the end
    of a way to an Object. ``offsets`` are the events of the poses that it goes over."""

    start: str
    end: str
    length_m: float
    places: tuple[NamedPlace, ...]
    doors: tuple[Door, ...]
    way_points: tuple[Spot, ...]
    goal: GoalPose | None
    offsets: tuple[int, ...]

    def __repr__(self) -> str:
        ends = f"{visible(self.start)} to {visible(self.end)}"
        return f"<way from {ends}: {self.length_m:.2f} m, {len(self.way_points):,} way points>"

    def document(self) -> dict[str, Any]:
        """As JSON."""
        goal = None if self.goal is None else self.goal.document()
        return {**asdict(self), "goal": goal}


def path(view: MapView, start: str, end: str, clearance_m: float = CLEARANCE_M) -> DrivenPath:
    """The shortest way over driven ground from one thing to another. Each is a point ``X,Y``, an
    Object or a Place, by any of its names: a Place is the pose in it next to its centre, an Object
    its goal. Raises MisuseError, also NoSuchThing and SeveralThings."""
    ground = view.once(DrivenGround)
    first, _ = _end_of(view, ground, start, clearance_m)
    last, goal = _end_of(view, ground, end, clearance_m)
    nodes = ground.nodes_between(first, last)
    if nodes is None:
        raise MisuseError(
            f"no way from {visible(start)} to {visible(end)}: no robot drove one in steps of"
            f" {STEP_M:g} m or less"
        )
    spots = [ground.spots[node] for node in nodes]
    keyframes = [ground.keyframe(node) for node in nodes]
    seen = zip(spots, keyframes, strict=True)
    placed = [(spot, each.place) for spot, each in seen if each.place is not None]
    if goal is not None and math.dist(spots[-1], (goal.x, goal.y)) > 0.0:
        spots.append((goal.x, goal.y))
    doors, places = list[Door](), list[PlaceOrdinal]()
    for number, ((bx, by), place) in enumerate(placed):
        if places and places[-1] == place:
            continue
        if places:
            ax, ay = placed[number - 1][0]
            ids = [view.all_places[each].place_id for each in (places[-1], place)]
            doors.append(Door((ax + bx) / 2, (ay + by) / 2, *ids))
        places.append(place)
    return DrivenPath(
        start,
        end,
        math.fsum(math.dist(a, b) for a, b in pairwise(spots)),
        tuple(_named(view, place) for place in places),
        tuple(doors),
        tuple(spots),
        goal,
        tuple(sorted({each.offset for each in keyframes})),
    )


def goal_of(view: MapView, object_id: str, clearance_m: float = CLEARANCE_M) -> GoalPose:
    """The pose from which to see an Object; see `goal_pose`."""
    found = _object(view, object_id)
    return view.once(GoalGround).goal(view, found, clearance_m)


def _end_of(
    view: MapView, ground: DrivenGround, text: str, clearance_m: float
) -> tuple[int, GoalPose | None]:
    """The node at an end of a way, and the goal where that is an Object."""
    point = point_of(text)
    if point is not None:
        return ground.nearest(point), None
    things = things_of(view)
    likely = things.likely(text)
    sure = [each for each in likely if each.kind == "place" or _is_confirmed(view, each)]
    thing = thing_called(text, sure if matches(text, sure)[1] else things, ["place", "object"])
    if thing.kind == "object":
        found = _object(view, thing.id)
        goal = view.once(GoalGround).goal(view, found, clearance_m)
        return ground.nearest((goal.x, goal.y)), goal
    place = view.survivors.find(PlaceOrdinal(thing.ordinal))
    record = view.all_places[place]
    nodes = set(ground.nodes_of(record.members))
    return ground.nearest((record.centroid_x, record.centroid_y), nodes), None


def _is_confirmed(view: MapView, thing: Thing) -> bool:
    return thing.ordinal in view.objects and view.all_objects[thing.ordinal].confirmed


def _object(view: MapView, object_id: str) -> ObjectRecord:
    thing = thing_called(object_id, things_of(view), ["object"])
    return view.all_objects[view.object_survivors.find(ObjectOrdinal(thing.ordinal))]


def _named(view: MapView, place: PlaceOrdinal) -> NamedPlace:
    kind, record = view.type_of(place), view.all_places[place]
    return NamedPlace(record.place_id, record.name, None if kind is None else kind.type)


def _visited(view: MapView, place: PlaceOrdinal) -> dict[str, Any]:
    """The fields of a `VisitedPlace`."""
    record, kind = view.all_places[place], view.type_of(place)
    visits = [view.keyframes[number] for number in record.members]
    region = view.once(place_regions).get(place)
    first, last = min(visits, key=_moment), max(visits, key=_moment)
    return {
        **asdict(_named(view, place)),
        "type_probability": None if kind is None else kind.probability,
        "floor": view.floor_of(place),
        "centroid_x": record.centroid_x,
        "centroid_y": record.centroid_y,
        "area_m2": None if region is None else region.area_m2,
        "keyframe_count": record.keyframe_count,
        "first_visited": seen_at(first),
        "last_visited": seen_at(last),
    }


def _moment(keyframe: KeyframeRecord) -> tuple[float, int]:
    return keyframe.timestamp, keyframe.offset
