"""The horizontal field of view of a camera that nothing states, from the map's own revisits.

Bearings of one thing from several spots meet in a point, and those from one spot differ by what the
robot turned, if the field of view is the right one. So it is the one with which bearings meet best:
for every candidate each thing is triangulated (robust least squares on the lines of sight), and its
cost is −2 log of the likelihood of what is left of the bearings, with heavy tails:

    2 · log(1 + z² / NU) + log v    v = (bearing error)² + (pose error / distance)²,  z² = left² / v

Boxes that the picture's border cuts at a side have no middle and are left out, and so are things
with fewer than `LEAST_OBSERVATIONS` others. Where the settings do not say the picture's size it is
the extent of all boxes, which is exact once the border cuts one.

The error is the larger of two: by the curvature of the cost, as if all bearings were independent,
and by the jackknife over groups of things, which also shows things that were fused wrongly. The
value is drawn towards what cameras usually have, by precision.

Minimum number of observations, scale and NU were chosen on the developing half of the trial data;
fields of view that are a degree off cost nothing, as do other errors of bearings and poses.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from projections.fold.evidence import EvidenceConstants
from projections.fold.settings import CameraConstants, CameraSettings

from .qualified_things import Floats, Ints, Row

USUAL_DEG, USUAL_SPREAD_DEG = 70.0, 15.0
"""Fields of view of robots' cameras: 50 to 95°, mostly."""
LEAST_OBSERVATIONS, LEAST_THINGS = 4, 5
_DEGREES = np.arange(26.0, 151.0, 2.0)
_SCALE2 = 2.25
_NU = 2.25
_ROUNDS = 12
_GROUPS = 20
_MOST_OF_A_THING = 64
_MOST_THINGS = 1000
_LEAST_RANGE_M = 0.2
_USUAL_RANGE_M = 1.5
_LEAST_INFORMATION = 1e-4
"""Of a thing's position, per m² and unit weight: about `_USUAL_RANGE_M` in front, where lines of
sight do not cross."""
_LEAST_ERROR_DEG = 0.3
_EDGE_PX, _MOST_PX = 1.0, 1e5
_DECIMALS = 1


class FieldOfView(NamedTuple):
    """A camera estimated from ``observations`` of ``things``. ``seen_deg`` is the estimate of the
    map alone and ``seen_error_deg`` its standard error, ``settings`` have the value drawn towards
    the usual one. ``measured_px`` says whether the picture's size is the extent of boxes."""

    settings: CameraSettings
    seen_deg: float
    seen_error_deg: float
    things: int
    observations: int
    measured_px: bool


def without_estimate(camera: CameraSettings) -> CameraSettings:
    """The settings without the field of view that an earlier calibration estimated."""
    return camera.model_copy(update=_NONE) if camera.hfov_error_deg is not None else camera


_NONE = {"hfov_deg": None, "hfov_error_deg": None}


def field_of_view(
    rows: Sequence[Row], camera: CameraSettings, prior: EvidenceConstants
) -> FieldOfView | None:
    """Estimate the camera of observations whose envelopes do not state it; None where too few
    things were seen often enough or no field of view is the best one."""
    if not rows:
        return None
    boxes = np.array([row.bbox for row in rows], dtype=np.float64)
    sized = _with_size(camera, boxes)
    lines = _lines(rows, boxes, sized.constants)
    if lines.things < LEAST_THINGS:
        return None
    costs = np.array([_costs(lines, each, prior) for each in _DEGREES])
    best = _lowest(costs.sum(axis=1))
    if best is None:
        return None
    seen, curved = best
    error = max(curved, _jackknife(costs), _LEAST_ERROR_DEG)
    if not math.isfinite(error):
        return None
    own, usual = error**-2, USUAL_SPREAD_DEG**-2
    drawn = (own * seen + usual * USUAL_DEG) / (own + usual)
    found = {
        "hfov_deg": round(drawn, _DECIMALS),
        "hfov_error_deg": round((own + usual) ** -0.5, _DECIMALS),
    }
    return FieldOfView(
        sized.model_copy(update=found),
        round(seen, _DECIMALS),
        round(error, _DECIMALS),
        lines.things,
        len(lines.x),
        camera.width_px is None or camera.height_px is None,
    )


def _with_size(camera: CameraSettings, boxes: Floats) -> CameraSettings:
    """The settings with the picture's size: that of the settings, else the extent of the boxes."""
    width, height = np.clip(np.ceil(boxes[:, 2:].max(axis=0)), 1.0, _MOST_PX).tolist()
    size = {"width_px": camera.width_px or width, "height_px": camera.height_px or height}
    return CameraSettings.model_validate(camera.model_dump() | size)


class _Lines(NamedTuple):
    """Lines of sight in the order of their things. ``across`` is the tangent of the bearing from
    the picture's axis, in units of that of the picture's left border; ``thing`` is numbered from
    0."""

    x: Floats
    y: Floats
    heading: Floats
    across: Floats
    thing: Ints
    things: int

    def sums(self, values: Floats) -> Floats:
        """The sum of the values of each thing."""
        return np.bincount(self.thing, values, self.things).astype(np.float64)


def _lines(rows: Sequence[Row], boxes: Floats, camera: CameraConstants) -> _Lines:
    left, top, right, bottom = boxes.T
    whole = (right > left) & (bottom > top)
    whole &= (left > _EDGE_PX) & (right < camera.width_px - _EDGE_PX)
    by_thing: dict[int, list[int]] = {}
    for index in np.flatnonzero(whole).tolist():
        by_thing.setdefault(rows[index].thing, []).append(index)
    often = [each for each in by_thing.values() if len(each) >= LEAST_OBSERVATIONS]
    often = [_thinned(each, _MOST_OF_A_THING) for each in _thinned(often, _MOST_THINGS)]
    indices = [index for each in often for index in each]
    picked = [rows[index] for index in indices]
    middle = (left + right)[indices] / 2.0
    return _Lines(
        np.array([row.pose.x_m for row in picked], dtype=np.float64),
        np.array([row.pose.y_m for row in picked], dtype=np.float64),
        np.array([row.pose.yaw_rad for row in picked], dtype=np.float64) + camera.yaw_rad,
        1.0 - middle / (camera.width_px / 2.0),
        np.arange(len(often)).repeat([len(each) for each in often]),
        len(often),
    )


T = TypeVar("T")


def _thinned(items: list[T], most: int) -> list[T]:
    """At most ``most`` of them, evenly."""
    return items[:: -(-len(items) // most)] if items else items


def _costs(lines: _Lines, hfov_deg: float, prior: EvidenceConstants) -> Floats:
    """The cost of each thing with this field of view."""
    sight = lines.heading + np.arctan(lines.across * math.tan(math.radians(hfov_deg) / 2.0))
    along_x, along_y = np.cos(sight), np.sin(sight)
    across_x, across_y = -along_y, along_x
    offset = across_x * lines.x + across_y * lines.y
    count = lines.sums(np.ones(len(sight)))
    near_x = lines.sums(lines.x + _USUAL_RANGE_M * along_x) / count
    near_y = lines.sums(lines.y + _USUAL_RANGE_M * along_y) / count
    weight = np.ones(len(sight))
    bearing2, pose2 = prior.bearing_rad**2, prior.pose_m**2
    for _ in range(_ROUNDS):
        xx = lines.sums(weight * across_x * across_x) + _LEAST_INFORMATION
        xy = lines.sums(weight * across_x * across_y)
        yy = lines.sums(weight * across_y * across_y) + _LEAST_INFORMATION
        right_x = lines.sums(weight * across_x * offset) + _LEAST_INFORMATION * near_x
        right_y = lines.sums(weight * across_y * offset) + _LEAST_INFORMATION * near_y
        det = xx * yy - xy * xy
        to_x = ((yy * right_x - xy * right_y) / det)[lines.thing] - lines.x
        to_y = ((xx * right_y - xy * right_x) / det)[lines.thing] - lines.y
        distance = np.maximum(np.hypot(to_x, to_y), _LEAST_RANGE_M)
        past = across_x * to_x + across_y * to_y
        variance = bearing2 * distance**2 + pose2
        weight = 1.0 / (variance * (1.0 + past**2 / (_SCALE2 * variance)))
    left = np.arctan2(past, along_x * to_x + along_y * to_y)
    variance = bearing2 + pose2 / distance**2
    return lines.sums(2.0 * np.log1p(left**2 / (_NU * variance)) + np.log(variance))


def _lowest(costs: Floats) -> tuple[float, float] | None:
    """The field of view with the least cost and the error that the curvature there gives; None at
    an end of the scale."""
    at = int(costs.argmin())
    if not 0 < at < len(costs) - 1:
        return None
    before, here, after = costs[at - 1 : at + 2].tolist()
    step = float(_DEGREES[1] - _DEGREES[0])
    bend = max(before - 2.0 * here + after, 1e-9)
    lowest = float(_DEGREES[at]) + step * (before - after) / (2.0 * bend)
    return lowest, step * math.sqrt(2.0 / bend)


def _jackknife(costs: Floats) -> float:
    """The standard error by leaving out one group of things after the other."""
    group = np.arange(costs.shape[1]) % _GROUPS
    groups = min(costs.shape[1], _GROUPS)
    lowest = [_lowest(costs[:, group != each].sum(axis=1)) for each in range(groups)]
    if None in lowest:
        return math.inf
    found = np.array([each[0] for each in lowest if each is not None])
    return math.sqrt((groups - 1) * float(np.mean((found - found.mean()) ** 2)))
