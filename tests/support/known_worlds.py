"""Observations of made-up things whose constants are known: for tests of the calibration.

Things stand in a room, a robot looks at each from random spots. Every error is normal with the
standard deviation that `Known` names; looks are unit vectors whose expected cosines are exactly
those of the model, through the features of the kernel exp(κ (cos Δ − 1)).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from projections.fold.deltas import Pose
from projections.fold.exact import metres_to_um, quantise
from projections.fold.settings import CameraConstants
from projections.localize.calibrate.qualified_things import Row

CAMERA = CameraConstants(hfov_deg=80.0, width_px=800.0, height_px=600.0)
DIM = 1024
_HARMONICS = 6


@dataclass(frozen=True)
class Known:
    """The constants of the world, and how much of it there is."""

    range_m: float = 2.5
    range_spread: float = 0.3
    bearing_rad: float = 0.03
    pose_m: float = 0.1
    size_spread: float = 0.15
    sizes_m: tuple[float, ...] = (0.4, 0.9, 1.5, 0.6)
    different: float = 0.5
    same_class: float = 0.4
    same_back: float = 0.55
    same_side: float = 0.25
    same_kappa: float = 2.0
    session_shift: float = 0.1
    side_by: str = "sight"
    camera: CameraConstants = CAMERA
    things: int = 120
    looks: int = 12
    runs: int = 2
    turned_rad: float = 0.0
    seed: int = 1


def rows_of(known: Known) -> list[Row]:
    """The observations; two things of other classes in every picture, sometimes one of one."""
    rng = np.random.default_rng(known.seed)
    looks = _Looks(known, rng)
    classes = len(known.sizes_m)
    tallness = known.size_spread * rng.normal(size=known.things)
    focal = known.camera.width_px / 2.0 / math.tan(math.radians(known.camera.hfov_deg) / 2.0)
    rows = []
    for picture in range(known.things * known.looks):
        thing, run = picture % known.things, int(rng.integers(known.runs))
        # A second thing beside it, the next one: of another class, of the same every 4th time.
        beside = (thing + (classes if picture % 4 == 0 else 1)) % known.things
        heading = float(rng.uniform(-math.pi, math.pi))
        for each in dict.fromkeys((thing, beside)):
            # Each is where the robot would see it: the pose is noised for each by itself.
            spot = np.array([each % 10, each // 10], dtype=float) * 20.0
            distance = known.range_m * math.exp(known.range_spread * rng.normal())
            side = float(rng.uniform(-math.pi, math.pi))
            off = float(rng.uniform(-0.5, 0.5))
            name = each % classes
            stands = spot - distance * np.array([math.cos(side), math.sin(side)])
            stands = stands + rng.normal(0.0, known.pose_m, 2)
            seen_at = side - off if known.side_by == "sight" else heading
            off = side - seen_at + known.bearing_rad * float(rng.normal()) + known.turned_rad
            off = math.remainder(off, 2.0 * math.pi)
            if abs(off) > 0.6:  # outside the picture
                continue
            size = known.sizes_m[name] * math.exp(tallness[each] + 0.05 * rng.normal())
            middle = known.camera.width_px / 2.0 - focal * math.tan(off)
            tall = size * focal / (distance * math.cos(off))
            tall = min(tall, known.camera.height_px - 20.0)
            top = (known.camera.height_px - tall) / 2.0
            rows.append(
                Row(
                    picture=picture,
                    run=run,
                    pose=Pose(
                        metres_to_um(float(stands[0])), metres_to_um(float(stands[1])), seen_at
                    ),
                    camera=known.camera,
                    class_name=f"class {name}",
                    bbox=(middle - 10.0, top, middle + 10.0, top + tall),
                    look=quantise(looks.of(each, side, seen_at, run).astype(np.float32)),
                    thing=each,
                )
            )
    return rows


class _Looks:
    """Unit vectors: the shares of space, class, thing, side, session and picture add up to 1."""

    def __init__(self, known: Known, rng: np.random.Generator) -> None:
        self._known, self._rng = known, rng
        self._directions: dict[tuple[object, ...], NDArray[np.float64]] = {}
        left = 1.0 - known.same_back - known.same_side
        if left < 0.0 or known.same_back < known.same_class + known.session_shift:
            raise ValueError("such looks are none")
        self._noise = left
        self._amplitudes = [math.sqrt(known.same_side * w) for w in _fourier(known.same_kappa)]

    def _direction(self, *key: object) -> NDArray[np.float64]:
        if key not in self._directions:
            vector = self._rng.normal(size=DIM)
            self._directions[key] = vector / np.linalg.norm(vector)
        return self._directions[key]

    def of(self, thing: int, side: float, heading: float, run: int) -> NDArray[np.float64]:
        """The look of a thing from a side in a run."""
        known = self._known
        own = known.same_back - known.same_class - known.session_shift
        angle = side if known.side_by == "sight" else heading
        parts = math.sqrt(known.same_class) * self._direction("class", thing % len(known.sizes_m))
        parts = parts + math.sqrt(own) * self._direction("thing", thing)
        parts = parts + math.sqrt(known.session_shift) * self._direction("session", thing, run)
        for n, amplitude in enumerate(self._amplitudes):
            parts = parts + amplitude * math.cos(n * angle) * self._direction("cos", thing, n)
            parts = parts + amplitude * math.sin(n * angle) * self._direction("sin", thing, n)
        noise = self._rng.normal(size=DIM)
        parts = parts + math.sqrt(self._noise) * noise / np.linalg.norm(noise)
        space = self._direction("space")
        whole: NDArray[np.float64] = (
            math.sqrt(known.different) * space + math.sqrt(1.0 - known.different) * parts
        )
        return whole


def _fourier(kappa: float) -> list[float]:
    """The weights w of exp(κ (cos Δ − 1)) = Σ wₙ cos nΔ, of harmonics 0 … by numerical mean."""
    angles = np.linspace(-math.pi, math.pi, 4096, endpoint=False)
    kernel = np.exp(kappa * (np.cos(angles) - 1.0))
    return [
        float((kernel * np.cos(n * angles)).mean()) * (1.0 if n == 0 else 2.0)
        for n in range(_HARMONICS)
    ]
