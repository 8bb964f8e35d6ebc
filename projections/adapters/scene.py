"""What is drawn of a map, for pictures, files and viewers: places with outline and label, objects
where they stand, ways, drives, the robot; and what pictures add: a plan, a lost robot, merges; and
the colours of all of these.

Lengths in metres, angles in radians.
"""

import colorsys
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeVar

from eventsrc.envelope.model import RunId
from projections.fold.deltas import Pose
from projections.fold.exact import UM_PER_M
from projections.map import records
from projections.map.place_regions import Region, place_regions
from projections.map.view import MapView

if TYPE_CHECKING:
    from eventsrc.adapters.sim import House

INK = "#22262b"
FAINT = "#8b939c"
WALL = "#3b4149"
FLOOR = "#fbfaf7"
FURNITURE = "#e9e5dc"
FURNITURE_EDGE = "#d8d2c4"
ROOM_NAME = "#6a7179"
SMALL_PRINT = "#4b525a"
LEADER = "#9aa1a9"
BRIDGE = "#8a1c7c"
TRUTH = "#0b0d10"
ESTIMATE = "#d3262e"

_BASE = (
    *("#3b82c4", "#e08a1e", "#3a9d5d", "#c2508f", "#7a63c7", "#b3a12a"),
    *("#2aa5a8", "#d9634c", "#7d8f2b", "#a2583b", "#5f7fe0", "#cf78c6"),
)
_GOLDEN = 0.618033988749895


def place_colour(index: int) -> str:
    """The colour of the ``index``-th place as #rrggbb: twelve chosen ones, then hues between."""
    if index < len(_BASE):
        return _BASE[index]
    red, green, blue = colorsys.hls_to_rgb((index * _GOLDEN) % 1.0, 0.45, 0.5)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"


_NEAR_M = 1.0
_MOST_LETTERS = 24
"""Most letters of a place's name; longer names are cut."""

Line = tuple[float, float, float, float]
Box = tuple[float, float, float, float]
Point = tuple[float, float]
_T = TypeVar("_T")
_MOST_POSES: Final = 2_000


@dataclass(frozen=True, slots=True)
class ShownPlace:
    """A place: its region, where walls are known, and the corners of the hull of its poses, none
    where these are on one line; ``label`` is its name or likely type, and its id."""

    record: records.PlaceRecord
    floor: str | None
    region: Region | None
    hull: tuple[Point, ...]
    label: str

    @property
    def outlines(self) -> tuple[tuple[Point, ...], ...]:
        """The closed outlines of the region or hull, the last point the first one."""
        if self.region is not None:
            return tuple(ring for rings in self.region.polygons for ring in rings)
        return ((*self.hull, self.hull[0]),) if self.hull else ()

    @property
    def centroid(self) -> Point:
        """The mean of its poses."""
        return self.record.centroid_x, self.record.centroid_y

    @property
    def colour(self) -> str:
        """Its colour, #rrggbb."""
        return place_colour(self.record.ordinal)


@dataclass(frozen=True, slots=True)
class ShownObject:
    """An object where it stands, on the floor that it was first seen from; ``label`` is its class,
    and whether it is missing."""

    record: records.ObjectRecord
    floor: str | None
    missing: bool

    @property
    def label(self) -> str:
        """Its class, and whether it is missing."""
        return f"{self.record.class_name} (missing)" if self.missing else self.record.class_name


@dataclass(frozen=True, slots=True)
class Way:
    """That robots went from one of two places to the other, how often."""

    ends: tuple[ShownPlace, ShownPlace]
    transitions: int


def places_of(view: MapView) -> list[ShownPlace]:
    """The places of a map, in the order in which they were founded."""
    found, regions = [], place_regions(view)
    for place in view.places.values():
        ring = hull(view.keyframes[member].pose for member in place.members)
        kind = view.type_of(place.ordinal)
        name = place.name or (kind.type if kind is not None else None)
        label = place.place_id if name is None else f"{name} ({place.place_id})"
        corners, region = tuple(ring) if len(ring) > 2 else (), regions.get(place.ordinal)
        found.append(ShownPlace(place, view.floor_of(place.ordinal), region, corners, label))
    return found


def objects_of(view: MapView, *, everything: bool = False) -> list[ShownObject]:
    """The confirmed objects of a map, or with ``everything`` all, in the order in which they were
    founded."""
    return [
        ShownObject(
            found,
            view.keyframes[view.observations[found.observations[0]].keyframe].floor,
            found.missing_in is not None,
        )
        for found in objects_shown(view, everything=everything)
    ]


def ways_of(view: MapView, places: Iterable[ShownPlace]) -> list[Way]:
    """The adjacent ones of a map's places."""
    by_ordinal = {place.record.ordinal: place for place in places}
    return [Way((by_ordinal[a], by_ordinal[b]), count) for a, b, count in view.edges()]


def robot_of(view: MapView) -> records.KeyframeRecord | None:
    """The latest keyframe that has a pose."""
    return next((k for k in reversed(view.keyframes) if k.pose is not None), None)


def thinned(items: Sequence[_T]) -> Sequence[_T]:
    """At most 2,000 of a path's poses and one of them, the last one included."""
    step = -(-len(items) // _MOST_POSES)
    return [*items[:-1:step], items[-1]] if items else []


def hull(poses: Iterable[Pose | None]) -> list[Point]:
    """Corners in metres of the convex hull of poses, counter-clockwise, by Andrew's monotone chain
    in whole micrometres: none lies on the line between its neighbours."""

    def chain(ordered: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        corners: list[tuple[int, int]] = []
        for x, y in ordered:
            while len(corners) > 1:
                (ax, ay), (bx, by) = corners[-2:]
                if (bx - ax) * (y - ay) > (by - ay) * (x - ax):
                    break
                corners.pop()
            corners.append((x, y))
        return corners[:-1]

    ordered = sorted({(pose.x_um, pose.y_um) for pose in poses if pose is not None})
    ring = chain(ordered) + chain(reversed(ordered)) if len(ordered) > 1 else ordered
    return [(x / UM_PER_M, y / UM_PER_M) for x, y in ring]


@dataclass(frozen=True, slots=True)
class HousePlan:
    """A house's plan: wall lines, furniture boxes, and where to write the rooms' names.

    Lines are x0, y0, x1, y1; boxes are x0, y0, x1, y1 with the lower corner first.
    """

    walls: tuple[Line, ...] = ()
    furniture: tuple[Box, ...] = ()
    rooms: tuple[tuple[str, Box], ...] = ()


@dataclass(frozen=True, slots=True)
class Spot:
    """A position, with a heading where one is known."""

    x: float
    y: float
    yaw_rad: float | None = None


@dataclass(frozen=True, slots=True)
class LostRobot:
    """Where a lost robot is, and where re-localisation puts it (None: no pose)."""

    truth: Spot
    estimate: Spot | None
    spread_m: float | None = None


@dataclass(frozen=True, slots=True)
class MergeMark:
    """The keyframe that merged places, and a label for it."""

    x: float
    y: float
    text: str


@dataclass(frozen=True, slots=True)
class ObjectGroup:
    """Objects of one class in one place near each other: one label, a dot for each.

    All of them are missing, or none is.
    """

    class_name: str
    place: int | None
    missing: bool
    members: tuple[records.ObjectRecord, ...]

    @property
    def obs_count(self) -> int:
        """Observations of all its members."""
        return sum(member.obs_count for member in self.members)

    @property
    def label(self) -> str:
        """The class, how many if more than one, and whether they are missing."""
        count, ending = len(self.members), " (missing)" if self.missing else ""
        return f"{self.class_name}{f' ×{count}' if count > 1 else ''}{ending}"

    @property
    def spot(self) -> tuple[float, float]:
        """The middle of its members."""
        xs, ys = zip(*(member.spot for member in self.members), strict=True)
        return sum(xs) / len(xs), sum(ys) / len(ys)


def object_groups(objects: Iterable[records.ObjectRecord]) -> list[ObjectGroup]:
    """The objects by place and class; most seen first."""
    grouped: dict[tuple[int | None, str, bool], list[list[records.ObjectRecord]]] = defaultdict(
        list
    )
    for found in objects:
        _add_to_group(grouped[found.place, found.class_name, found.missing_in is not None], found)
    groups = [
        ObjectGroup(name, place, missing, tuple(members))
        for (place, name, missing), clumps in grouped.items()
        for members in clumps
    ]
    return sorted(groups, key=lambda group: (-group.obs_count, group.members[0].ordinal))


def objects_shown(
    view: MapView, *, everything: bool = False, min_observations: int = 1
) -> list[records.ObjectRecord]:
    """The confirmed objects, or with ``everything`` all, that were seen at least that often."""
    return [
        found
        for found in view.objects.values()
        if (everything or found.confirmed) and found.obs_count >= min_observations
    ]


def two_sigma(at: records.EstimatedPosition) -> tuple[float, float, float]:
    """The ellipse of two standard errors around an estimate: full width and height in metres, and
    the angle from the x axis to the width, in degrees."""
    half = (at.var_xx_um2 + at.var_yy_um2) / 2
    apart, across = (at.var_xx_um2 - at.var_yy_um2) / 2, float(at.var_xy_um2)
    spread = math.hypot(apart, across)
    wide, high = (4e-6 * math.sqrt(max(v, 0.0)) for v in (half + spread, half - spread))
    return wide, high, math.degrees(math.atan2(across, apart) / 2)


def _add_to_group(clumps: list[list[records.ObjectRecord]], found: records.ObjectRecord) -> None:
    """Add an object to the first clump whose first member is near, else begin another."""
    for clump in clumps:
        if math.dist(clump[0].spot, found.spot) <= _NEAR_M:
            clump.append(found)
            return
    clumps.append([found])


def place_names(view: MapView) -> dict[int, str]:
    """The label of each place, absorbed ones too: the name that a command gave it, else its short
    id: p3, or run_p3 where two runs have a p3. Places that share a name have their ids too.
    """
    short = {p.ordinal: p.place_id.rpartition("_")[2] for p in view.all_places}
    used = Counter(short.values())
    ids: dict[int, str] = {
        ordinal: name if used[name] == 1 else view.all_places[ordinal].place_id
        for ordinal, name in short.items()
    }
    given: dict[int, str] = {
        p.ordinal: _cut(p.name) for p in view.places.values() if p.name is not None
    }
    shared = Counter([*given.values(), *ids.values()])
    return ids | {
        ordinal: name if shared[name] == 1 else f"{name} ({ids[ordinal]})"
        for ordinal, name in given.items()
    }


def place_badges(view: MapView) -> dict[int, str]:
    """`place_names`, with the type of the place below an id, if it is known."""
    labels = place_names(view)
    for place in view.places.values():
        kind = view.type_of(place.ordinal) if place.name is None else None
        if kind is not None and kind.type is not None:
            labels[place.ordinal] += f"\n{kind.type}?"
    return labels


def _cut(name: str) -> str:
    return name if len(name) <= _MOST_LETTERS else f"{name[: _MOST_LETTERS - 1]}…"


def spot_of(keyframe: records.KeyframeRecord) -> tuple[float, float] | None:
    """A keyframe's position, None without a pose."""
    if keyframe.pose is None:
        return None
    return keyframe.pose.x_um / 1e6, keyframe.pose.y_um / 1e6


def drives(view: MapView) -> list[tuple[RunId, list[tuple[float, float]]]]:
    """Per run its id and its positions, in keyframe_id order."""
    by_run: dict[int, list[records.KeyframeRecord]] = defaultdict(list)
    for keyframe in view.keyframes:
        by_run[keyframe.run].append(keyframe)
    result = []
    for run in view.runs:
        ordered = sorted(by_run[run.ordinal], key=lambda k: k.keyframe_id)
        result.append((run.run_id, [s for k in ordered if (s := spot_of(k)) is not None]))
    return result


def place_spots(view: MapView) -> dict[int, list[tuple[float, float]]]:
    """Per place the positions of its keyframes."""
    return {
        ordinal: [s for k in place.members if (s := spot_of(view.keyframes[k])) is not None]
        for ordinal, place in view.places.items()
    }


def plan_of(house: "House") -> HousePlan:
    """Walls, standing furniture and room names of ``house``."""
    standing = (thing.footprint for thing in house.things if thing.model.stands)
    return HousePlan(
        walls=tuple((wall.x0, wall.y0, wall.x1, wall.y1) for wall in house.plan.walls),
        furniture=tuple((rect.x0, rect.y0, rect.x1, rect.y1) for rect in standing),
        rooms=tuple(
            (room.name, (room.rect.x0, room.rect.y0, room.rect.x1, room.rect.y1))
            for room in house.plan.rooms
        ),
    )
