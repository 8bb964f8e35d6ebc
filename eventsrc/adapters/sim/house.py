"""A furnished house: a floor plan and the objects in it, from one seed.

Objects of one model look alike: the six dining chairs are one model, the office chair another.
Sizes are width along the wall, depth from it, and height, in metres; ``base_m`` is the height of
the lower edge above the floor. A model with ``stands`` takes floor space; any other hangs on the
wall or stands on something.

Furniture stands with its back to a wall, clear of doors and of each other; the dining set stands
free. A furnishing is accepted only if the robot can drive from every room to every other; otherwise
the next attempt is drawn.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from eventsrc.base.errors import MapfoldError
from eventsrc.envelope.occupancy_map import OCCUPIED, OccupancyMap

from .drive import DriveGrid
from .floorplan import FloorPlan, PlannedDoor, PlannedRoom, Point, Rect, Walls, build_floor_plan
from .random_streams import stream, uniform


@dataclass(frozen=True, slots=True)
class Model:
    """A product model; objects of the same model look nearly the same."""

    name: str
    class_name: str
    width_m: float
    depth_m: float
    height_m: float
    base_m: float = 0.0
    stands: bool = True


_MODELS = (
    Model("couch-linen", "couch", 1.9, 0.85, 0.8),
    Model("armchair-oak", "armchair", 0.8, 0.8, 0.9),
    Model("tv-55", "tv", 1.2, 0.3, 0.75, 0.5),
    Model("bookcase-tall", "bookcase", 0.9, 0.35, 1.9),
    Model("lamp-floor", "lamp", 0.35, 0.35, 1.5),
    Model("lamp-bedside", "lamp", 0.3, 0.3, 0.5, 0.4, stands=False),
    Model("plant-fern", "potted plant", 0.4, 0.4, 0.9),
    Model("plant-cactus", "potted plant", 0.3, 0.3, 0.6),
    Model("table-dining", "dining table", 1.4, 0.9, 0.75),
    Model("chair-dining", "chair", 0.45, 0.45, 0.9),
    Model("chair-office", "chair", 0.6, 0.6, 1.0),
    Model("vase-blue", "vase", 0.2, 0.2, 0.35, 0.75, stands=False),
    Model("picture-print", "picture", 0.6, 0.05, 0.45, 1.0, stands=False),
    Model("picture-portrait", "picture", 0.5, 0.05, 0.7, 0.9, stands=False),
    Model("clock-round", "clock", 0.35, 0.05, 0.35, 1.1, stands=False),
    Model("refrigerator-steel", "refrigerator", 0.7, 0.7, 1.7),
    Model("oven-black", "oven", 0.6, 0.6, 0.85),
    Model("sink-kitchen", "sink", 0.7, 0.6, 0.9),
    Model("sink-bath", "sink", 0.6, 0.45, 0.85),
    Model("microwave-white", "microwave", 0.5, 0.4, 0.3, 0.9, stands=False),
    Model("bin-pedal", "trash can", 0.3, 0.3, 0.55),
    Model("bed-double", "bed", 1.6, 2.0, 0.6),
    Model("bed-single", "bed", 0.9, 2.0, 0.6),
    Model("wardrobe-white", "wardrobe", 1.2, 0.6, 1.9),
    Model("mirror-plain", "mirror", 0.5, 0.05, 0.8, 0.8, stands=False),
    Model("toilet-round", "toilet", 0.4, 0.65, 0.8),
    Model("bathtub-long", "bathtub", 1.6, 0.75, 0.6),
    Model("desk-birch", "desk", 1.3, 0.65, 0.75),
    Model("laptop-grey", "laptop", 0.35, 0.25, 0.25, 0.75, stands=False),
    Model("printer-office", "printer", 0.45, 0.4, 0.3, 0.5, stands=False),
    Model("bear-brown", "teddy bear", 0.35, 0.3, 0.45, 0.4, stands=False),
    Model("suitcase-red", "suitcase", 0.45, 0.3, 0.7),
    Model("rack-coats", "coat rack", 0.5, 0.4, 1.7),
    Model("bench-hall", "bench", 0.9, 0.35, 0.45),
)

MODELS = {model.name: model for model in _MODELS}

FURNITURE: dict[str, tuple[str, ...]] = {
    "living room": (
        *("couch-linen", "tv-55", "armchair-oak", "armchair-oak", "bookcase-tall"),
        *("lamp-floor", "plant-fern", "picture-print", "picture-print", "clock-round"),
    ),
    "dining room": ("plant-cactus", "picture-print", "vase-blue", "lamp-floor"),
    "kitchen": (
        *("refrigerator-steel", "oven-black", "sink-kitchen", "microwave-white"),
        *("bin-pedal", "chair-dining", "chair-dining", "clock-round"),
    ),
    "bedroom": (
        *("bed-double", "wardrobe-white", "lamp-bedside", "lamp-bedside"),
        *("mirror-plain", "picture-portrait"),
    ),
    "bathroom": ("bathtub-long", "toilet-round", "sink-bath", "mirror-plain", "bin-pedal"),
    "study": (
        *("desk-birch", "bookcase-tall", "chair-office", "laptop-grey"),
        *("printer-office", "plant-fern", "picture-print"),
    ),
    "guest room": (
        *("bed-single", "wardrobe-white", "lamp-bedside", "suitcase-red"),
        *("bear-brown", "picture-portrait"),
    ),
    "hall": ("rack-coats", "bench-hall", "plant-cactus", "mirror-plain", "picture-print"),
}
"""Model names by room, in the order in which they are placed: large ones first."""

DINING_SET = ("table-dining", "chair-dining", "chair-dining", "chair-dining", "chair-dining")
"""Placed together in the dining room: the table and four chairs around it."""


_ATTEMPTS = 40
_TRIES = 250
_DOOR_CLEAR_M = 0.85
_CHAIR_OFFSETS = ((-0.35, -0.7), (0.35, -0.7), (-0.35, 0.7), (0.35, 0.7))
_MAP_RESOLUTION_M = 0.05
_MAP_MARGIN = 10
"""Cells around the outermost walls."""


@dataclass(frozen=True, slots=True)
class SimulatedThing:
    """One object. ``instance`` is its true identity, ``facing_rad`` the direction of its front."""

    instance: str
    model: Model
    room: str
    footprint: Rect
    facing_rad: float

    @property
    def centre(self) -> Point:
        """The middle of its footprint."""
        return self.footprint.centre


@dataclass(frozen=True)
class House:
    """A floor plan with things in it."""

    seed: int
    plan: FloorPlan
    things: tuple[SimulatedThing, ...]

    @cached_property
    def walls(self) -> Walls:
        """The walls, for lines of sight."""
        return Walls(self.plan.walls)

    @cached_property
    def grid(self) -> DriveGrid:
        """The floor where the robot can drive."""
        return _grid(self.plan, self.things)


def build_house(seed: int) -> House:
    """The house of this seed. Raises MapfoldError if every attempt blocks a room."""
    plan = build_floor_plan(seed)
    for attempt in range(_ATTEMPTS):
        things = _furnish(plan, stream("furniture", seed, attempt))
        if things is not None and _grid(plan, things).connects(
            [room.rect.centre for room in plan.rooms]
        ):
            return House(seed, plan, _with_instances(seed, things))
    raise MapfoldError(
        f"house {seed}: no furnishing leaves every room reachable; try another --seed"
    )


def _grid(plan: FloorPlan, things: tuple[SimulatedThing, ...]) -> DriveGrid:
    return DriveGrid(
        plan.outline, Walls(plan.walls), [t.footprint for t in things if t.model.stands]
    )


def _with_instances(seed: int, things: tuple[SimulatedThing, ...]) -> tuple[SimulatedThing, ...]:
    """Name the instances of a model house7-model-1, house7-model-2 … in the order of placing. No
    two houses share an instance."""
    counts: dict[str, int] = {}
    named: list[SimulatedThing] = []
    for thing in things:
        count = counts[thing.model.name] = counts.get(thing.model.name, 0) + 1
        named.append(replace(thing, instance=f"house{seed}-{thing.model.name}-{count}"))
    return tuple(named)


def _furnish(plan: FloorPlan, rng: np.random.Generator) -> tuple[SimulatedThing, ...] | None:
    """Everything in FURNITURE and the dining set; None when something does not fit."""
    placed: list[SimulatedThing] = []
    dining = _dining_set(plan, rng)
    if dining is None:
        return None
    placed.extend(dining)
    for room in plan.rooms:
        for name in FURNITURE[room.name]:
            thing = _against_a_wall(plan, room, MODELS[name], placed, rng)
            if thing is None:
                return None
            placed.append(thing)
    return tuple(placed)


def _dining_set(plan: FloorPlan, rng: np.random.Generator) -> list[SimulatedThing] | None:
    room = plan.room("dining room")
    keep_clear = list(_door_areas(plan, room))
    for _ in range(_TRIES):
        x = round(uniform(rng, room.rect.x0 + 1.1, room.rect.x1 - 1.1), 2)
        y = round(uniform(rng, room.rect.y0 + 1.1, room.rect.y1 - 1.1), 2)
        if any(Rect.around(x, y, 1.7, 2.0).overlaps(clear) for clear in keep_clear):
            continue
        table, *chairs = (MODELS[name] for name in DINING_SET)
        things = [_thing(table, room, Rect.around(x, y, table.width_m, table.depth_m), 0)]
        for chair, (dx, dy) in zip(chairs, _CHAIR_OFFSETS, strict=True):
            spot = Rect.around(x + dx, y + dy, chair.width_m, chair.depth_m)
            things.append(_thing(chair, room, spot, 1 if dy < 0 else 3))
        return things
    return None


def _against_a_wall(
    plan: FloorPlan,
    room: PlannedRoom,
    model: Model,
    placed: list[SimulatedThing],
    rng: np.random.Generator,
) -> SimulatedThing | None:
    taken = [t.footprint for t in placed if t.room == room.name and t.model.stands == model.stands]
    taken += _door_areas(plan, room)
    for _ in range(_TRIES):
        side = int(rng.integers(0, 4))
        spot = _spot(room.rect, model, side, uniform(rng, 0.0, 1.0))
        if room.rect.encloses(spot) and not any(spot.grown(0.05).overlaps(t) for t in taken):
            return _thing(model, room, spot, side)
    return None


def _spot(rect: Rect, model: Model, side: int, along: float) -> Rect:
    """The footprint with its back to a side (0 west, 1 south, 2 east, 3 north), 5 cm off it."""
    gap = 0.05 + model.depth_m / 2
    if side in (0, 2):
        half = model.width_m / 2 + 0.05
        y = round(rect.y0 + half + along * (rect.height - 2 * half), 2)
        x = rect.x0 + gap if side == 0 else rect.x1 - gap
        return Rect.around(x, y, model.depth_m, model.width_m)
    half = model.width_m / 2 + 0.05
    x = round(rect.x0 + half + along * (rect.width - 2 * half), 2)
    y = rect.y0 + gap if side == 1 else rect.y1 - gap
    return Rect.around(x, y, model.width_m, model.depth_m)


def _thing(model: Model, room: PlannedRoom, spot: Rect, side: int) -> SimulatedThing:
    """``side`` is the wall at its back; its front faces the other way."""
    quarter_turns = {0: 0.0, 1: 0.5, 2: 1.0, 3: -0.5}
    return SimulatedThing("", model, room.name, spot, quarter_turns[side] * np.pi)


def _door_areas(plan: FloorPlan, room: PlannedRoom) -> Iterator[Rect]:
    """The floor around the room's doors, which stays free."""
    for door in plan.doors:
        if room.name in door.rooms:
            yield _door_area(door)


def _door_area(door: PlannedDoor) -> Rect:
    deep, wide = 2 * _DOOR_CLEAR_M, door.width_m
    return Rect.around(*door.centre, *((wide, deep) if door.flat else (deep, wide)))


def occupancy_map(house: House) -> OccupancyMap:
    """The walls as an occupancy map, without furniture and without unknown cells. A wall occupies
    the cells that its line is in."""
    lines = [(w.x0, w.y0, w.x1, w.y1) for w in house.plan.walls]
    left = _cell(min(min(x0, x1) for x0, _, x1, _ in lines)) - _MAP_MARGIN
    below = _cell(min(min(y0, y1) for _, y0, _, y1 in lines)) - _MAP_MARGIN
    columns = _cell(max(max(x0, x1) for x0, _, x1, _ in lines)) - left + _MAP_MARGIN + 1
    rows = _cell(max(max(y0, y1) for _, y0, _, y1 in lines)) - below + _MAP_MARGIN + 1
    cells = np.zeros((rows, columns), np.uint8)
    for line in lines:
        x0, y0, x1, y1 = map(_cell, line)
        spans = sorted((y0 - below, y1 - below)), sorted((x0 - left, x1 - left))
        cells[spans[0][0] : spans[0][1] + 1, spans[1][0] : spans[1][1] + 1] = OCCUPIED
    origin = round(left * _MAP_RESOLUTION_M, 6), round(below * _MAP_RESOLUTION_M, 6), 0.0
    return OccupancyMap(f"house-{house.seed}", _MAP_RESOLUTION_M, origin, "simulated house", cells)


def _cell(metres: float) -> int:
    """The index of a cell. Walls lie on tenths of a millimetre, so the division is exact enough."""
    return round(metres * 10_000) // round(_MAP_RESOLUTION_M * 10_000)
