"""Seeded streams for the benchmark: walks, a house, keyframes with detections."""

import math
import random
from collections.abc import Iterator

import numpy as np

from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.model import Detection, DetId, Envelope
from projections.fold.settings import CameraConstants

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


def pictures(count: int) -> Iterator[Accepted]:
    """Keyframes of `house_walk` that look where the robot drives: of the 60 pieces of furniture the
    nearest three in view, their boxes as a camera with the settings' defaults draws them."""
    rng, camera = np.random.default_rng(9), CameraConstants()
    spots = rng.uniform((0, 0), (WIDTH_M, DEPTH_M), (60, 2))
    heights, elevations = rng.uniform(0.3, 1.5, 60), rng.uniform(-0.4, 0.4, 60)
    classes = rng.normal(size=(20, DIM))
    looks = classes[np.arange(60) % 20] * 0.8 + rng.normal(size=(60, DIM)) * 0.5
    half = camera.width_px / 2
    focal = half / math.tan(math.radians(camera.hfov_deg / 2))
    before, yaw = (5.0, 7.0), 0.0
    for index, (x, y) in enumerate(house_walk(count)):
        if (x, y) != before:
            yaw = math.atan2(y - before[1], x - before[0])
        before, (cos, sin) = (x, y), (math.cos(yaw), math.sin(yaw))
        dx, dy = spots[:, 0] - x, spots[:, 1] - y
        ahead, aside = dx * cos + dy * sin, dy * cos - dx * sin
        in_view = (ahead > 0.5) & (ahead < 6.0) & (np.abs(aside) < ahead * half / focal)
        nearest = [int(i) for i in np.argsort(np.where(in_view, ahead, np.inf))[:3] if in_view[i]]
        seen = rng.normal(size=(len(nearest), 2)) * 3.0  # pixels
        seen += np.array([half, camera.height_px / 2])
        seen -= focal * np.array([aside[nearest], elevations[nearest]]).T / ahead[nearest, None]
        tall = focal * heights[nearest] / ahead[nearest] / 2
        most = camera.width_px, camera.height_px
        boxes = [
            tuple(float(min(max(at, 0.0), m)) for at, m in zip(box, most * 2, strict=True))
            for box in np.column_stack((seen - tall[:, None], seen + tall[:, None]))
        ]
        noise = rng.normal(size=(len(nearest), DIM)) * 0.35
        yield _accepted(index, x, y, nearest, (looks[nearest] + noise).astype("<f4"), yaw, boxes)


def _accepted(
    index: int,
    x: float,
    y: float,
    seen: list[int],
    vectors: np.ndarray,
    yaw: float = 0.5,
    boxes: list[tuple[float, ...]] | None = None,
) -> Accepted:
    left, top = 120.0 + index % 64, 80.0 + index % 48  # objects of their own, as JSON gives them
    if boxes is None:
        boxes = [(left + i, top + i, left + i + 130.0, top + i + 230.0) for i in seen]
    detections = tuple(
        Detection(
            det_id=None,
            class_name=f"class {which % 20}",
            confidence=0.5 + which / 128,
            bbox=box,
            embedding=None,
            embedding_dim=DIM,
            embedding_model=MODEL,
        )
        for which, box in zip(seen, boxes, strict=True)
    )
    envelope = Envelope(
        run_id="robot",
        keyframe_id=index,
        timestamp=1.7e9 + index,
        map_x=x,
        map_y=y,
        map_yaw=yaw,
        detections=detections,
    )
    det_ids = tuple(DetId(f"robot_kf{index}_d{i}") for i in range(len(seen)))
    return Accepted(envelope, det_ids, tuple(vectors))
