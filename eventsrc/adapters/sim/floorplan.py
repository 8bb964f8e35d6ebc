"""A floor plan from a seed, in plane geometry of metres: rectangles, wall segments, lines of sight.

Day rooms are on one side of a hall, night rooms on the other.

+---------+-----+-------+--------+
| bedroom |bath | study | guest  |     the order, widths, door positions and the side of the
+---- ----+- ---+-- ----+--- ----+     day rooms depend on the seed
|              hall              |
+-------- ---+--------+--- ------+
|   living     dining   kitchen  |     living and dining room share a wide opening
+------------+--------+----------+
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .random_streams import bernoulli, stream, uniform

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rect:
    """A rectangle with sides along x and y; x0 <= x1 and y0 <= y1."""

    x0: float
    y0: float
    x1: float
    y1: float

    @classmethod
    def around(cls, x: float, y: float, width: float, height: float) -> "Rect":
        """The rectangle of this size with its centre at (x, y)."""
        return cls(x - width / 2, y - height / 2, x + width / 2, y + height / 2)

    @property
    def centre(self) -> Point:
        """The coordinates of the centre."""
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    @property
    def width(self) -> float:
        """The extent along x."""
        return self.x1 - self.x0

    @property
    def height(self) -> float:
        """The extent along y."""
        return self.y1 - self.y0

    def grown(self, by: float) -> "Rect":
        """The same rectangle with ``by`` added on each side."""
        return Rect(self.x0 - by, self.y0 - by, self.x1 + by, self.y1 + by)

    def contains(self, x: float, y: float) -> bool:
        """Whether (x, y) is inside or on the edge."""
        return self.x0 <= x <= self.x1 and self.y0 <= y <= self.y1

    def encloses(self, other: "Rect") -> bool:
        """Whether ``other`` lies wholly inside."""
        return self.contains(other.x0, other.y0) and self.contains(other.x1, other.y1)

    def overlaps(self, other: "Rect") -> bool:
        """Whether the two share more than an edge."""
        return (
            self.x0 < other.x1 and other.x0 < self.x1 and self.y0 < other.y1 and other.y0 < self.y1
        )


@dataclass(frozen=True, slots=True)
class Segment:
    """A straight piece of wall from (x0, y0) to (x1, y1)."""

    x0: float
    y0: float
    x1: float
    y1: float


class Walls:
    """Wall segments as arrays, for vectorised queries."""

    def __init__(self, segments: Sequence[Segment]) -> None:
        ends = np.array([(s.x0, s.y0, s.x1, s.y1) for s in segments], dtype=np.float64)
        self._start = ends[:, 0:2]
        self._along = ends[:, 2:4] - ends[:, 0:2]

    def block(self, a: Point, b: Point) -> bool:
        """Whether any wall crosses or touches the line from ``a`` to ``b``."""
        ray = np.array([b[0] - a[0], b[1] - a[1]])
        to_start = self._start - np.array(a)
        across = _cross(ray, self._along)
        parallel = across == 0.0
        safe = np.where(parallel, 1.0, across)
        on_ray = _cross(to_start, self._along) / safe
        on_wall = _cross(to_start, ray) / safe
        hit = (on_ray >= 0) & (on_ray <= 1) & (on_wall >= 0) & (on_wall <= 1) & ~parallel
        return bool(hit.any())

    def clearance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of each of ``points``, shape (n, 2), to the nearest wall, shape (n,)."""
        nearest = np.full(len(points), math.inf)
        for start, along in zip(self._start, self._along, strict=True):
            length_2 = max(float(along[0] * along[0] + along[1] * along[1]), 1e-12)
            offset = points - start
            t = (offset[:, 0] * along[0] + offset[:, 1] * along[1]) / length_2
            t = np.clip(t, 0.0, 1.0)
            dx = offset[:, 0] - t * along[0]
            dy = offset[:, 1] - t * along[1]
            nearest = np.minimum(nearest, np.sqrt(dx * dx + dy * dy))
        return nearest


def rect_clearance(rect: Rect, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each of ``points``, shape (n, 2), to ``rect``; 0 inside. Shape (n,)."""
    dx = np.maximum(np.maximum(rect.x0 - points[:, 0], points[:, 0] - rect.x1), 0.0)
    dy = np.maximum(np.maximum(rect.y0 - points[:, 1], points[:, 1] - rect.y1), 0.0)
    distance: NDArray[np.float64] = np.sqrt(dx * dx + dy * dy)
    return distance


def wrap(angle: float) -> float:
    """``angle`` in radians, brought into (-π, π]."""
    wrapped = math.fmod(angle, 2 * math.pi)
    if wrapped > math.pi:
        return wrapped - 2 * math.pi
    return wrapped + 2 * math.pi if wrapped <= -math.pi else wrapped


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    product: NDArray[np.float64] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return product


DOOR_M = 1.0
OPENING_M = 2.0
DAY_ROOMS = ("living room", "dining room", "kitchen")
NIGHT_ROOMS = ("bedroom", "bathroom", "study", "guest room")
HALL = "hall"

_WIDTHS_M = {
    "living room": (5.2, 6.0),
    "dining room": (4.0, 4.6),
    "kitchen": (3.8, 4.4),
    "bedroom": (3.8, 4.4),
    "bathroom": (2.6, 3.0),
    "study": (3.4, 4.0),
    "guest room": (3.2, 3.8),
}


@dataclass(frozen=True, slots=True)
class PlannedRoom:
    """A room and its inner extent."""

    name: str
    rect: Rect


@dataclass(frozen=True, slots=True)
class PlannedDoor:
    """A gap in the wall between two rooms. ``flat`` if the wall runs along x."""

    rooms: tuple[str, str]
    centre: Point
    width_m: float
    flat: bool


@dataclass(frozen=True, slots=True)
class FloorPlan:
    """Rooms, doors and walls; the walls already have the doors cut out."""

    outline: Rect
    rooms: tuple[PlannedRoom, ...]
    doors: tuple[PlannedDoor, ...]
    walls: tuple[Segment, ...]

    def room_at(self, x: float, y: float) -> str | None:
        """The name of the room around (x, y), None outside."""
        return next((room.name for room in self.rooms if room.rect.contains(x, y)), None)

    def room(self, name: str) -> PlannedRoom:
        """The room of this name."""
        return next(room for room in self.rooms if room.name == name)


def build_floor_plan(seed: int) -> FloorPlan:
    """The floor plan of house ``seed``: eight rooms, eight doors."""
    rng = stream("floor plan", seed)
    widths = {name: round(uniform(rng, *span), 1) for name, span in _WIDTHS_M.items()}
    length = round(sum(widths[name] for name in DAY_ROOMS), 1)
    day_depth, hall_depth = round(uniform(rng, 4.2, 4.8), 1), round(uniform(rng, 1.6, 1.9), 1)
    night_depth = round(uniform(rng, 3.8, 4.4), 1)
    day_first = bernoulli(rng, 0.5)
    depths = (
        (day_depth, hall_depth, night_depth) if day_first else (night_depth, hall_depth, day_depth)
    )
    levels = (0.0, depths[0], round(depths[0] + depths[1], 1), round(sum(depths), 1))
    day = _row(_order(rng, DAY_ROOMS, shuffle=False), widths, length, *_band(levels, day_first))
    night = _row(
        _order(rng, NIGHT_ROOMS, shuffle=True), widths, length, *_band(levels, not day_first)
    )
    hall = PlannedRoom(HALL, Rect(0.0, levels[1], length, levels[2]))
    doors = _doors(rng, day, night, levels[1:3], day_first=day_first)
    outline = Rect(0.0, 0.0, length, levels[3])
    return FloorPlan(
        outline, (*day, hall, *night), doors, _walls(outline, levels, day, night, doors)
    )


def _band(levels: tuple[float, ...], first: bool) -> tuple[float, float]:
    return (levels[0], levels[1]) if first else (levels[2], levels[3])


def _order(rng: np.random.Generator, names: tuple[str, ...], *, shuffle: bool) -> list[str]:
    if shuffle:
        return [names[index] for index in rng.permutation(len(names)).tolist()]
    return list(names) if bernoulli(rng, 0.5) else list(reversed(names))


def _row(
    names: list[str], widths: dict[str, float], length: float, y0: float, y1: float
) -> tuple[PlannedRoom, ...]:
    """Rooms side by side, stretched so that together they are ``length`` long."""
    scale = length / sum(widths[name] for name in names)
    rooms: list[PlannedRoom] = []
    x = 0.0
    for index, name in enumerate(names):
        end = length if index == len(names) - 1 else round(x + widths[name] * scale, 1)
        rooms.append(PlannedRoom(name, Rect(x, y0, end, y1)))
        x = end
    return tuple(rooms)


def _doors(
    rng: np.random.Generator,
    day: tuple[PlannedRoom, ...],
    night: tuple[PlannedRoom, ...],
    hall_sides: tuple[float, ...],
    *,
    day_first: bool,
) -> tuple[PlannedDoor, ...]:
    day_y, night_y = hall_sides if day_first else hall_sides[::-1]
    doors = [_hall_door(rng, room, night_y) for room in night]
    doors += [_hall_door(rng, room, day_y) for room in day if room.name != "dining room"]
    for left, right in itertools.pairwise(day):
        wide = {left.name, right.name} == {"living room", "dining room"}
        width = OPENING_M if wide else DOOR_M
        margin = 0.4 + width / 2
        y = round(uniform(rng, left.rect.y0 + margin, left.rect.y1 - margin), 1)
        doors.append(PlannedDoor((left.name, right.name), (left.rect.x1, y), width, flat=False))
    return tuple(doors)


def _hall_door(rng: np.random.Generator, room: PlannedRoom, y: float) -> PlannedDoor:
    margin = 0.3 + DOOR_M / 2
    x = round(uniform(rng, room.rect.x0 + margin, room.rect.x1 - margin), 1)
    return PlannedDoor((room.name, HALL), (x, y), DOOR_M, flat=True)


def _walls(
    outline: Rect,
    levels: tuple[float, ...],
    day: tuple[PlannedRoom, ...],
    night: tuple[PlannedRoom, ...],
    doors: tuple[PlannedDoor, ...],
) -> tuple[Segment, ...]:
    walls: list[Segment] = []
    for y in levels:
        gaps = [(d.centre[0], d.width_m) for d in doors if d.flat and d.centre[1] == y]
        walls += [Segment(a, y, b, y) for a, b in _cut(outline.x0, outline.x1, gaps)]
    for row in (day, night):
        edges = [outline.x0, *(room.rect.x1 for room in row)]
        y0, y1 = row[0].rect.y0, row[0].rect.y1
        for x in edges:
            gaps = [(d.centre[1], d.width_m) for d in doors if not d.flat and d.centre[0] == x]
            inside = gaps if row is day else []
            walls += [Segment(x, a, x, b) for a, b in _cut(y0, y1, inside)]
    walls += [Segment(x, levels[1], x, levels[2]) for x in (outline.x0, outline.x1)]
    return tuple(walls)


def _cut(start: float, end: float, gaps: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The pieces of the line from ``start`` to ``end`` between its ``gaps`` (centre, width)."""
    pieces: list[tuple[float, float]] = []
    for centre, width in sorted(gaps):
        pieces.append((start, centre - width / 2))
        start = centre + width / 2
    return [*pieces, (start, end)]
