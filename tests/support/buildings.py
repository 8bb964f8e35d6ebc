"""Buildings to fit and check re-localisation on: none of them is the trial data or the simulator.

Rooms on a grid, doors from a spanning tree, walls that hide, furniture at walls, some models in
several copies (look-alikes, half of them in one room), a robot that drives from door to door and
looks around, a 69° camera. Only what matters to re-localisation is modelled. An embedding is the
sum of parts sized so that cosines come out as between house-a and house-b of the trial data: 0.86
for the same thing from the same side, 0.78 from behind, look-alikes 0.02 below, other models of a
class near 0.69, other classes near 0.52. Everything follows from the seeds.

Runs through a `buildings.Building`: where the robot goes and what it sees there.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import DetId, Envelope

WIDTH, HEIGHT, HALF_FOV = 640.0, 400.0, math.radians(69.4 / 2)
FOCAL = WIDTH / 2 / math.tan(HALF_FOV)
PARTS = {"common": 0.52, "class": 0.17, "model": 0.07, "side": 0.083, "instance": 0.022}
SESSION, NOISE = 0.049, 0.088
HARMONICS = 6
KAPPA = 1.2

Vector = NDArray[np.float64]
Node = tuple[int, int]


def direction(rng: np.random.Generator) -> Vector:
    """A random unit vector of 512 dimensions."""
    vector = rng.standard_normal(512)
    return vector / np.linalg.norm(vector)


def side_weights() -> Vector:
    """Amplitudes of a random function on the circle whose correlation is exp(κ(cos Δ − 1))."""
    grid = np.arange(720) * (2 * np.pi / 720)
    kernel = np.exp(KAPPA * (np.cos(grid) - 1))
    powers = np.array([(kernel * np.cos(k * grid)).mean() for k in range(HARMONICS)])
    powers[1:] *= 2
    return np.sqrt(powers / powers.sum())


@dataclass
class Thing:
    """One piece of furniture. ``fixed`` is its embedding but for side, session and noise."""

    instance: str
    class_index: int
    x: float
    y: float
    facing: float
    size_m: float
    fixed: Vector
    sides: list[tuple[Vector, Vector]]


@dataclass
class Keyframe:
    """One keyframe as the fold takes it, with its truth."""

    accepted: Accepted
    room: str
    instances: list[str | None]


@dataclass
class Building:
    """A floor plan with furniture; `drive` makes runs through it."""

    seed: int
    columns: int = 3
    rows: int = 2
    things: int = 60
    classes: int = 22
    look_alikes: float = 0.5
    kin: int | None = None
    """Buildings with the same ``kin`` share classes and what is common to all crops."""
    walls: list[tuple[float, float, float, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.xs = np.concatenate(([0.0], np.cumsum(3 + 2.5 * rng.random(self.columns))))
        self.ys = np.concatenate(([0.0], np.cumsum(3 + 2.5 * rng.random(self.rows))))
        self._make_doors(rng)
        self._make_walls()
        self.common = direction(rng)
        self.class_directions = [direction(rng) for _ in range(self.classes)]
        if self.kin is not None:
            shared = np.random.default_rng(self.kin)
            self.common = direction(shared)
            self.class_directions = [direction(shared) for _ in range(self.classes)]
        self.furniture: list[Thing] = []
        while len(self.furniture) < self.things:
            self._add_model(rng)
        del self.furniture[self.things :]

    def room(self, x: float, y: float) -> str:
        """The room a position is in."""
        return f"r{int(np.searchsorted(self.xs, x)) - 1}-{int(np.searchsorted(self.ys, y)) - 1}"

    def _make_doors(self, rng: np.random.Generator) -> None:
        cols, rows = range(self.columns), range(self.rows)
        pairs = [((i, j), (i + 1, j)) for i in cols[:-1] for j in rows]
        pairs += [((i, j), (i, j + 1)) for i in cols for j in rows[:-1]]
        group = {(i, j): (i, j) for i in cols for j in rows}
        self.doors: dict[tuple[Node, Node], tuple[float, float]] = {}
        for index in rng.permutation(len(pairs)):
            a, b = pairs[index]
            joined = group[a] == group[b]
            if joined and rng.random() >= 0.25:
                continue
            old = group[b]
            group = {node: group[a] if g == old else g for node, g in group.items()}
            along = 0.2 + 0.6 * rng.random()
            if a[0] != b[0]:
                low, high = self.ys[a[1]], self.ys[a[1] + 1]
                place = (float(self.xs[b[0]]), float(low + along * (high - low)))
            else:
                low, high = self.xs[a[0]], self.xs[a[0] + 1]
                place = (float(low + along * (high - low)), float(self.ys[b[1]]))
            self.doors[a, b] = self.doors[b, a] = place

    def _make_walls(self) -> None:
        for i in range(self.columns + 1):
            for j in range(self.rows):
                door = self.doors.get(((i - 1, j), (i, j)))
                for a, b in _gaps(self.ys[j], self.ys[j + 1], None if door is None else door[1]):
                    self.walls.append((float(self.xs[i]), a, float(self.xs[i]), b))
        for j in range(self.rows + 1):
            for i in range(self.columns):
                door = self.doors.get(((i, j - 1), (i, j)))
                for a, b in _gaps(self.xs[i], self.xs[i + 1], None if door is None else door[0]):
                    self.walls.append((a, float(self.ys[j]), b, float(self.ys[j])))

    def _add_model(self, rng: np.random.Generator) -> None:
        class_index = int(rng.integers(self.classes))
        model, size_m = direction(rng), 0.25 + 0.9 * rng.random()
        sides = [(direction(rng), direction(rng)) for _ in range(HARMONICS)]
        copies = int(rng.integers(2, 7)) if rng.random() < self.look_alikes / 2 else 1
        together = rng.random() < 0.5
        node = self._any_node(rng)
        for _ in range(copies):
            node = node if together else self._any_node(rng)
            x, y = self._spot(rng, node)
            fixed = (
                math.sqrt(PARTS["common"]) * self.common
                + math.sqrt(PARTS["class"]) * self.class_directions[class_index]
                + math.sqrt(PARTS["model"]) * model
                + math.sqrt(PARTS["instance"]) * direction(rng)
            )
            name = f"b{self.seed}-{len(self.furniture)}"
            facing = 2 * math.pi * rng.random()
            self.furniture.append(Thing(name, class_index, x, y, facing, size_m, fixed, sides))

    def _any_node(self, rng: np.random.Generator) -> Node:
        return int(rng.integers(self.columns)), int(rng.integers(self.rows))

    def _spot(self, rng: np.random.Generator, node: Node) -> tuple[float, float]:
        x0, x1 = float(self.xs[node[0]]) + 0.25, float(self.xs[node[0] + 1]) - 0.25
        y0, y1 = float(self.ys[node[1]]) + 0.25, float(self.ys[node[1] + 1]) - 0.25
        u, v = rng.random(), rng.random()
        if rng.random() < 0.25:
            return x0 + 0.5 + u * (x1 - x0 - 1), y0 + 0.5 + v * (y1 - y0 - 1)
        wall = int(rng.integers(4))
        along_x, along_y = x0 + u * (x1 - x0), y0 + u * (y1 - y0)
        return [(x0, along_y), (x1, along_y), (along_x, y0), (along_x, y1)][wall]


def _gaps(low: float, high: float, door: float | None) -> list[tuple[float, float]]:
    """A wall's pieces: whole, or with 0.9 m left out for a door."""
    if door is None:
        return [(float(low), float(high))]
    return [(float(low), door - 0.45), (door + 0.45, float(high))]


STEP_M, TURN_RAD = 0.5, math.radians(15)
MISSED, WRONG_LABEL, PHANTOM = 0.2, 0.04, 0.02
RANGE_M = (0.7, 4.5)
_SIDES = side_weights()


def drive(building: Building, run_id: str, seed: int, keyframes: int) -> list[Keyframe]:
    """A run of ``keyframes`` keyframes at 0.5 m or 15°; another seed is another session."""
    rng = np.random.default_rng(seed)
    session = direction(rng)
    found = []
    for number, pose in enumerate(_tour(building, rng), start=1):
        found.append(_keyframe(building, run_id, number, pose, session, rng))
        if len(found) == keyframes:
            return found
    raise AssertionError("a tour never ends")


Pose = tuple[float, float, float]


def _tour(building: Building, rng: np.random.Generator) -> Iterator[Pose]:
    node: Node = (int(rng.integers(building.columns)), int(rng.integers(building.rows)))
    x, y = _inside(building, rng, node)
    yaw = 2 * math.pi * rng.random()
    visits: dict[Node, int] = {node: 1}
    yield x, y, yaw
    while True:
        goals = [_inside(building, rng, node) for _ in range(int(rng.integers(1, 3)))]
        for goal in goals:
            yield from (poses := list(_go(x, y, yaw, goal)))
            x, y, yaw = (*goal, poses[-1][2] if poses else yaw)
        if rng.random() < 0.6:
            yield from _look_around(x, y, yaw)
        neighbours = sorted(b for a, b in building.doors if a == node)
        weights = np.array([1 / (1 + visits.get(n, 0)) ** 2 for n in neighbours])
        following = neighbours[int(rng.choice(len(neighbours), p=weights / weights.sum()))]
        door = building.doors[node, following]
        sign = 1 if following > node else -1
        across = (0.3 * sign, 0.0) if node[0] != following[0] else (0.0, 0.3 * sign)
        for end in (-1, 1):
            goal = (door[0] + end * across[0], door[1] + end * across[1])
            yield from (poses := list(_go(x, y, yaw, goal)))
            x, y, yaw = (*goal, poses[-1][2] if poses else yaw)
        node = following
        visits[node] = visits.get(node, 0) + 1


def _inside(building: Building, rng: np.random.Generator, node: Node) -> tuple[float, float]:
    x0, x1 = building.xs[node[0]], building.xs[node[0] + 1]
    y0, y1 = building.ys[node[1]], building.ys[node[1] + 1]
    u, v = 0.25 + 0.5 * rng.random(), 0.25 + 0.5 * rng.random()
    return float(x0 + u * (x1 - x0)), float(y0 + v * (y1 - y0))


def _go(x: float, y: float, yaw: float, goal: tuple[float, float]) -> Iterator[Pose]:
    heading = math.atan2(goal[1] - y, goal[0] - x)
    left = math.remainder(heading - yaw, 2 * math.pi)
    while abs(left) > TURN_RAD:
        yaw += math.copysign(TURN_RAD, left)
        left = math.remainder(heading - yaw, 2 * math.pi)
        yield x, y, yaw
    distance = math.hypot(goal[0] - x, goal[1] - y)
    for step in range(1, int(distance / STEP_M) + 1):
        part = step * STEP_M
        yield x + part * math.cos(heading), y + part * math.sin(heading), heading


def _look_around(x: float, y: float, yaw: float) -> Iterator[Pose]:
    for step in range(1, 24):
        yield x, y, yaw + step * TURN_RAD


def _keyframe(
    building: Building,
    run_id: str,
    number: int,
    pose: Pose,
    session: Vector,
    rng: np.random.Generator,
) -> Keyframe:
    x, y, yaw = pose
    detections, vectors, instances = [], [], []
    for thing in building.furniture:
        box = _box(building, thing, pose, rng)
        if box is None or rng.random() < MISSED:
            continue
        wrong = rng.random() < WRONG_LABEL
        label = int(rng.integers(building.classes)) if wrong else thing.class_index
        detections.append(_detection(run_id, number, len(detections), label, box))
        vectors.append(_embedding(thing, pose, session, rng))
        instances.append(thing.instance)
    if rng.random() < PHANTOM:
        label = int(rng.integers(building.classes))
        left = 540 * rng.random()
        box = (left, 100.0, left + 100.0, 200.0)
        detections.append(_detection(run_id, number, len(detections), label, box))
        vectors.append(_phantom(building, label, session, rng))
        instances.append(None)
    envelope = msgspec.convert(
        {
            "run_id": run_id,
            "keyframe_id": number,
            "timestamp": 1_700_000_000.0 + number,
            "map_x": x,
            "map_y": y,
            "map_yaw": math.remainder(yaw, 2 * math.pi),
            "detections": detections,
        },
        Envelope,
    )
    det_ids = tuple(DetId(str(d["det_id"])) for d in detections)
    return Keyframe(Accepted(envelope, det_ids, tuple(vectors)), building.room(x, y), instances)


def _detection(
    run_id: str, number: int, index: int, label: int, box: tuple[float, float, float, float]
) -> dict[str, object]:
    det_id = f"{run_id}_kf{number}_d{index}"
    return {"det_id": det_id, "class": f"class {label}", "confidence": 0.8, "bbox": box}


def _box(
    building: Building, thing: Thing, pose: Pose, rng: np.random.Generator
) -> tuple[float, float, float, float] | None:
    x, y, yaw = pose
    dx, dy = thing.x - x, thing.y - y
    reach, bearing = math.hypot(dx, dy), math.remainder(math.atan2(dy, dx) - yaw, 2 * math.pi)
    if not RANGE_M[0] <= reach <= RANGE_M[1] or abs(bearing) > 0.98 * HALF_FOV:
        return None
    if _hidden(building, (x, y), (x + 0.97 * dx, y + 0.97 * dy)):
        return None
    half = thing.size_m * FOCAL / (reach * math.cos(bearing)) / 2
    centre = WIDTH / 2 - FOCAL * math.tan(bearing)
    e = rng.normal(0, 4, 4)
    left, right = max(0.0, centre - half + e[0]), min(WIDTH, centre + half + e[2])
    top, bottom = max(0.0, HEIGHT / 2 - half + e[1]), min(HEIGHT, HEIGHT / 2 + half + e[3])
    return float(left), float(top), float(right), float(bottom)


def _hidden(building: Building, a: tuple[float, float], b: tuple[float, float]) -> bool:
    walls = np.array(building.walls)
    start, end = walls[:, :2], walls[:, 2:]
    p, q = np.array(a), np.array(b)

    def side(u: Vector, v: Vector) -> Vector:
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    parted = side(end - start, p - start) * side(end - start, q - start) < 0
    crossed = side(q - p, start - p) * side(q - p, end - p) < 0
    return bool((parted & crossed).any())


def _embedding(
    thing: Thing, pose: Pose, session: Vector, rng: np.random.Generator
) -> "np.ndarray[tuple[int], np.dtype[np.float32]]":
    seen_from = math.atan2(pose[1] - thing.y, pose[0] - thing.x) - thing.facing
    side = np.zeros(512)
    for k in range(HARMONICS):
        front, flank = thing.sides[k]
        wave = math.cos(k * seen_from) * front + math.sin(k * seen_from) * flank
        side += _SIDES[k] * wave
    total = thing.fixed + math.sqrt(PARTS["side"]) * side
    total = total + math.sqrt(SESSION) * session + math.sqrt(NOISE) * direction(rng)
    return (total / np.linalg.norm(total)).astype(np.float32)


def _phantom(
    building: Building, label: int, session: Vector, rng: np.random.Generator
) -> "np.ndarray[tuple[int], np.dtype[np.float32]]":
    own = 1 - PARTS["common"] - PARTS["class"] - SESSION
    total = math.sqrt(PARTS["common"]) * building.common
    total = total + math.sqrt(PARTS["class"]) * building.class_directions[label]
    total = total + math.sqrt(SESSION) * session + math.sqrt(own) * direction(rng)
    return (total / np.linalg.norm(total)).astype(np.float32)
