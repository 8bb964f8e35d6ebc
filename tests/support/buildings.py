"""Buildings to fit and check re-localisation on: none of them is the trial data or the simulator.

Rooms on a grid, doors from a spanning tree, walls that hide, furniture at walls, some models in
several copies (look-alikes, half of them in one room), a robot that drives from door to door and
looks around, a 69° camera. Only what matters to re-localisation is modelled. An embedding is the
sum of parts sized so that cosines come out as between house-a and house-b of the trial data: 0.86
for the same thing from the same side, 0.78 from behind, look-alikes 0.02 below, other models of a
class near 0.69, other classes near 0.52. Everything follows from the seeds.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.ingest import Accepted

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
