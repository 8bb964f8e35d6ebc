"""Seeded streams for the benchmark: walks, a house, keyframes with detections."""

import math
import random
from collections.abc import Iterator

import numpy as np

from eventsrc.envelope import Detection, DetId, Envelope
from eventsrc.ingest import Accepted

WIDTH_M, DEPTH_M = 20.0, 15.0
DIM = 512
MODEL = "ViT-B-32/laion2b_s34b_b79k"


def random_walk(count: int, step_m: float = 1.0) -> list[tuple[int, int]]:
    """A robot that turns a little and goes a step, on an open plane; micrometres."""
    rng, points = random.Random(7), []
    x = y = heading = 0.0
    for _ in range(count):
        heading += rng.gauss(0, 0.6)
        x, y = x + step_m * math.cos(heading), y + step_m * math.sin(heading)
        points.append((round(x * 1e6), round(y * 1e6)))
    return points


def house_walk(count: int) -> Iterator[tuple[float, float]]:
    """A robot that keeps driving in a house of 20 × 15 m with a wall and a door; metres."""
    rng = random.Random(8)
    x, y, heading = 5.0, 7.0, 0.0
    for _ in range(count):
        heading += rng.gauss(0, 0.4)
        nx, ny = x + 0.5 * math.cos(heading), y + 0.5 * math.sin(heading)
        is_wall = 9.2 < nx < 10.8 and not 6 < ny < 8
        if 0 < nx < WIDTH_M and 0 < ny < DEPTH_M and not is_wall:
            x, y = nx, ny
        else:
            heading += math.pi * 0.7
        yield x, y


def keyframes(count: int, detections: int) -> Iterator[Accepted]:
    """Keyframes of `house_walk`, each seeing the nearest of 60 pieces of furniture."""
    rng = np.random.default_rng(9)
    spots = rng.uniform((0, 0), (WIDTH_M, DEPTH_M), (60, 2))
    classes = rng.normal(size=(20, DIM))
    looks = classes[np.arange(60) % 20] * 0.8 + rng.normal(size=(60, DIM)) * 0.5
    for index, (x, y) in enumerate(house_walk(count)):
        nearest = np.argpartition(((spots - (x, y)) ** 2).sum(axis=1), 3)[:detections]
        noise = rng.normal(size=(len(nearest), DIM)) * 0.35
        vectors = (looks[nearest] + noise).astype("<f4")
        yield _accepted(index, x, y, [int(i) for i in nearest], vectors)


def _accepted(index: int, x: float, y: float, seen: list[int], vectors: np.ndarray) -> Accepted:
    left, top = 120.0 + index % 64, 80.0 + index % 48  # objects of their own, as JSON gives them
    detections = tuple(
        Detection.model_construct(
            det_id=None,
            class_name=f"class {which % 20}",
            confidence=0.5 + which / 128,
            bbox=(left + which, top + which, left + which + 130.0, top + which + 230.0),
            embedding=None,
            embedding_dim=DIM,
            embedding_model=MODEL,
        )
        for which in seen
    )
    envelope = Envelope.model_construct(
        run_id="robot",
        keyframe_id=index,
        timestamp=1.7e9 + index,
        map_x=x,
        map_y=y,
        map_yaw=0.5,
        detections=detections,
    )
    det_ids = tuple(DetId(f"robot_kf{index}_d{i}") for i in range(len(seen)))
    return Accepted(envelope, det_ids, tuple(vectors))
