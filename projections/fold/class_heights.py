"""Heights of the things of a class, and of their centres above the camera, learned from the map.

A thing whose estimate is sure gives its class the logarithm of its size and its elevation. The next
thing of the class starts from their mean, so that one uncut box gives its distance. The sums are
integers, and a thing's older values are subtracted before new ones are added: the result depends on
the latest values only, not on their order. Elevations are metres above the camera.
"""

from collections.abc import Mapping
from typing import NamedTuple

from . import State
from .exact import log

_UNIT = 1 << 16
_UNKNOWN = 3.0
"""The number of things that the prior spread weighs as much as."""
_SPREAD = 0.3
_SURE_M2 = 0.15
_SURE_SIZE = 0.1


class HeightPrior(NamedTuple):
    """Mean and precision (1 / variance) of a class's log size, and of its elevation in metres."""

    log_size: float
    log_size_weight: float
    elevation: float
    elevation_weight: float


Given = tuple[str, int, int]
"""The values that a thing added: class name, log size and elevation in units of 2⁻¹⁶."""
UNKNOWN_CLASS = HeightPrior(-0.4, 2.0, 0.0, 0.25)


class ClassHeights:
    """Sums over the sure things of each class."""

    def __init__(self, sizes_m: Mapping[str, float], size_spread: float) -> None:
        weight = 1.0 / (size_spread * size_spread)
        self._stated = {
            name: HeightPrior(log(size), weight, 0.0, UNKNOWN_CLASS.elevation_weight)
            for name, size in sizes_m.items()
        }
        self._sums: dict[str, list[int]] = {}

    def prior(self, class_name: str) -> HeightPrior:
        """The prior of a thing of this class."""
        stated = self._stated.get(class_name, UNKNOWN_CLASS)
        sums = self._sums.get(class_name)
        if sums is None or sums[0] == 0:
            return stated
        count, sizes, sizes2, elevations, elevations2 = sums
        share = (1.0 + 1.0 / count) / (count + _UNKNOWN - 1.0)
        elevation, spread = _moments(count, elevations, elevations2)
        of_elevation = elevation, 1.0 / ((spread + _UNKNOWN * _SPREAD * _SPREAD) * share)
        if class_name in self._stated:
            return HeightPrior(stated[0], stated[1], *of_elevation)
        log_size, spread = _moments(count, sizes, sizes2)
        weight = 1.0 / ((spread + _UNKNOWN * _SPREAD * _SPREAD) * share)
        return HeightPrior(log_size, weight, *of_elevation)

    def give(
        self,
        before: Given | None,
        class_name: str,
        log_size: float,
        size_variance: float,
        elevation: float,
        variance_m2: float,
        spots: int,
    ) -> Given | None:
        """Replace the values that a thing added before; by nothing if its estimate is not sure
        enough."""
        if spots < 2 or variance_m2 >= _SURE_M2 or size_variance >= _SURE_SIZE:
            if before is not None:
                self._add(before, -1)
            return None
        given = class_name, round(log_size * _UNIT), round(elevation * _UNIT)
        if given != before:
            if before is not None:
                self._add(before, -1)
            self._add(given, 1)
        return given

    def remove(self, given: Given) -> None:
        """Subtract the values that a thing added."""
        self._add(given, -1)

    def _add(self, given: Given, sign: int) -> None:
        class_name, size, elevation = given
        sums = self._sums.get(class_name)
        if sums is None:
            sums = self._sums[class_name] = [0, 0, 0, 0, 0]
        sums[0] += sign
        sums[1] += sign * size
        sums[2] += sign * size * size
        sums[3] += sign * elevation
        sums[4] += sign * elevation * elevation

    def dump(self) -> State:
        """The whole state, for a snapshot."""
        return {"sums": sorted([name, *sums] for name, sums in self._sums.items())}

    def load(self, state: State) -> None:
        """Restore the state of `dump`."""
        self._sums = {name: list(sums) for name, *sums in state["sums"]}


def _moments(count: int, total: int, squares: int) -> tuple[float, float]:
    """Mean and sum of squared deviations."""
    return total / (count * _UNIT), (count * squares - total * total) / (count * _UNIT * _UNIT)
