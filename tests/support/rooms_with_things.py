"""Runs through a small room with things that stand somewhere, seen through a camera.

Not a measure of how good a map is: labels flicker, looks are noisy, boxes are cut, robots get lost
and things are carried elsewhere, so that a few keyframes meet every branch of fusion by evidence.
"""

import math
import random
from typing import Any

from hypothesis import strategies as st

from tests.support.envelopes import detection, envelope

CLASSES = ("cup", "chair", "lamp")
DIM = 6
_WIDTH, _HEIGHT, _HFOV = 640.0, 400.0, 69.4
_FOCAL = _WIDTH / 2 / math.tan(math.radians(_HFOV) / 2)


class Room:
    """Things of a room; `keyframe` is what a robot sees from a pose."""

    def __init__(self, seed: int, things: int) -> None:
        self.rng = random.Random(seed)
        self.things = [
            (
                self.rng.choice(CLASSES),
                [self.rng.gauss(0, 1) + 0.6 for _ in range(DIM)],
                [self.rng.uniform(0, 5), self.rng.uniform(0, 4)],
            )
            for _ in range(things)
        ]

    def carry(self) -> None:
        """A thing is somewhere else."""
        if self.things:
            self.rng.choice(self.things)[2][:] = [self.rng.uniform(0, 5), self.rng.uniform(0, 4)]

    def keyframe(self, number: int, run: str) -> dict[str, Any]:
        """An envelope; some have no pose, a camera of their own, depths, positions, odd labels."""
        rng = self.rng
        x, y, yaw = rng.uniform(0, 5), rng.uniform(0, 4), rng.uniform(-7, 7)
        seen = []
        for name, look, (tx, ty) in self.things:
            bearing = math.remainder(math.atan2(ty - y, tx - x) - yaw, 2 * math.pi)
            distance = math.hypot(tx - x, ty - y)
            if abs(bearing) > math.radians(_HFOV) / 2 or distance < 0.3:
                continue
            centre = _WIDTH / 2 - _FOCAL * math.tan(bearing)
            half = _FOCAL * 0.2 / distance
            box = [centre - half, 200 - half, centre + half, 200 + half]
            fields: dict[str, Any] = {}
            if rng.random() < 0.15:
                fields["depth_m"] = distance
                if rng.random() < 0.5:
                    fields["depth_sigma_m"] = 0.2
            if rng.random() < 0.1:
                fields["position"] = [tx, ty]
            vector = None if rng.random() < 0.05 else [v + rng.gauss(0, 0.2) for v in look]
            label = rng.choice(CLASSES) if rng.random() < 0.15 else name
            clipped = [min(max(v, 0.0), m) for v, m in zip(box, (640, 400) * 2, strict=True)]
            seen.append(detection(label, vector, bbox=clipped, **fields))
        more: dict[str, Any] = {"map_yaw": yaw} if rng.random() > 0.08 else {}
        if rng.random() < 0.1:
            more["camera"] = {"hfov_deg": 80.0, "width_px": 640.0, "height_px": 400.0}
        posed = x if "map_yaw" in more else None
        return envelope(number, posed, y, run_id=run, detections=seen, **more)


def drive(seed: int, count: int, things: int = 6) -> list[dict[str, Any]]:
    """Keyframes of two runs; between them a thing is carried elsewhere; some come twice."""
    room = Room(seed, things)
    documents = []
    for number in range(count):
        if number == count // 2:
            room.carry()
        documents.append(room.keyframe(number, "run-a" if number < count // 2 else "run-b"))
        if room.rng.random() < 0.05:
            documents.append(room.rng.choice(documents))
    return documents


def long_drive(seed: int, runs: int = 3, each: int = 80) -> list[dict[str, Any]]:
    """Keyframes of several runs, and two things carried elsewhere before each but the first."""
    room = Room(seed, 8)
    documents = []
    for run in range(runs):
        if run:
            room.carry()
            room.carry()
        numbers = range(each * run, each * (run + 1))
        documents += [room.keyframe(number, f"run-{run}") for number in numbers]
    return documents


@st.composite
def drives(draw: st.DrawFn, most: int = 30) -> list[dict[str, Any]]:
    """`drive` of any length and seed."""
    seed, things = draw(st.integers(0, 2**32)), draw(st.integers(0, 7))
    return drive(seed, draw(st.integers(0, most)), things)
