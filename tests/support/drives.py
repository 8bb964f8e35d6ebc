"""Runs through a `buildings.Building`: where the robot goes and what it sees there."""

import math
from collections.abc import Iterator

import msgspec
import numpy as np

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import DetId, Envelope
from tests.support.buildings import (
    FOCAL,
    HALF_FOV,
    HARMONICS,
    HEIGHT,
    NOISE,
    PARTS,
    SESSION,
    WIDTH,
    Building,
    Keyframe,
    Node,
    Thing,
    Vector,
    direction,
    side_weights,
)

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
