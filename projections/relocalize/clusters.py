"""Points of one crop's matches grouped into things, and how sure the place of each thing is.

A match's point is unsure along its ray, because the box's height is noisy, and hardly across it: a
bearing is good to about a degree. So two chairs half a metre apart are told apart from the side,
where one circle around every point would melt them into one thing that fits neither. A thing's
place is the mean weighted by information (the inverse of those errors); three views along one ray
leave the range open, two that cross do not.

The crops of a thing share one size, so an error in it moves all points outward together: by
``slide``, metres per unit of log size.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .camera import Flags, Floats
from .model import Model

Indices = NDArray[np.intp]

_LEAST_REACH_M = 0.3
_LEAST_PULL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points (n, 2) with the rays (n, 2) that lead to them from where they were seen, in metres.

    ``along`` and ``across`` (n,) are their standard errors in and square to the ray's direction,
    whose unit vectors ``ahead`` holds (2, n). ``moments`` (7, n) are what weighted sums are made
    of: the inverse of a point's covariance (xx, xy, yy), that times the point, and that times the
    ray.
    """

    at: Floats
    ray: Floats
    along: Floats
    across: Floats
    ahead: Floats
    moments: Floats

    def of(self, index: Indices) -> "Points":
        """Those at ``index``."""
        return Points(
            self.at[index],
            self.ray[index],
            self.along[index],
            self.across[index],
            self.ahead[:, index],
            self.moments[:, index],
        )


def points_of(origin: Floats, ray: Floats, cut: Flags, sigma_size: float, model: Model) -> Points:
    """Points at the ends of the rays; ``cut`` marks boxes that are cut off or missing."""
    length = np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2)
    reach = np.maximum(length, _LEAST_REACH_M)
    depth = np.where(cut, model.map_log_depth_cut, model.map_log_depth)
    bearing = np.where(cut, model.map_bearing_cut, model.map_bearing)
    along = np.sqrt(depth * depth + sigma_size**2) * reach + model.map_least
    across = bearing * reach + model.map_least
    safe = np.where(length > 0, length, 1.0)
    ux, uy = np.where(length > 0, ray[:, 0] / safe, 1.0), ray[:, 1] / safe  # no length: along x
    a, b = 1.0 / (along * along), 1.0 / (across * across)
    at = origin + ray
    xx, xy, yy = a * ux * ux + b * uy * uy, (a - b) * ux * uy, a * uy * uy + b * ux * ux
    rows = [xx, xy, yy]
    for x, y in (at.T, ray.T):
        rows += [xx * x + xy * y, xy * x + yy * y]
    return Points(at, ray, along, across, np.stack((ux, uy)), np.stack(rows))


def clusters(points: Points, weight: Floats, most: int, model: Model) -> list[Indices]:
    """Grouped around the densest point, then around the densest of the rest, and so on."""
    chi = _misfit(points, points.at[:, None, :])
    near = np.exp(-0.5 * chi)
    free = np.ones(len(weight), dtype=bool)
    found: list[Indices] = []
    while free.any() and len(found) < most:
        support = (near * (weight * free)).sum(1)
        centre = int(np.argmax(np.where(free, support, -1.0)))
        place = _mean(points, near[centre] * free)
        mine = free & (_misfit(points, np.array(place)) < model.gate)
        mine[centre] = True
        found.append(np.flatnonzero(mine))
        free &= ~mine
    return found


@dataclass(frozen=True, slots=True)
class Settled:
    """A thing's place in metres; ``spread`` is the covariance (xx, xy, yy) of it in m²."""

    x: float
    y: float
    spread: tuple[float, float, float]
    slide: tuple[float, float]


def settle(points: Points, model: Model) -> Settled:
    """The place of the thing that all ``points`` show, outliers counting little."""
    centre = np.array(_mean(points, np.ones(len(points.at))))
    pull = np.maximum(np.exp(-0.5 * _misfit(points, centre)), _LEAST_PULL)
    sxx, sxy, syy, x, y, ray_x, ray_y = (points.moments * pull).sum(1).tolist()
    det, least = sxx * syy - sxy * sxy, model.sigma_landmark**2
    spread = (syy / det + least, -sxy / det, sxx / det + least)
    at = _solve(sxx, sxy, syy, x, y)
    return Settled(*at, spread, _solve(sxx, sxy, syy, ray_x, ray_y))


def _misfit(points: Points, to: Floats) -> Floats:
    """χ² of each point being at ``to``, of shape (2,) or (m, 1, 2)."""
    ux, uy = points.ahead
    dx, dy = to[..., 0] - points.at[:, 0], to[..., 1] - points.at[:, 1]
    along, across = (dx * ux + dy * uy) / points.along, (dy * ux - dx * uy) / points.across
    chi: Floats = along * along + across * across
    return chi


def _mean(points: Points, weight: Floats) -> tuple[float, float]:
    """The mean place, weighted by information too."""
    return _solve(*(points.moments[:5] * weight).sum(1).tolist())


def _solve(xx: float, xy: float, yy: float, x: float, y: float) -> tuple[float, float]:
    """The vector that the symmetric matrix takes to (x, y)."""
    det = xx * yy - xy * xy
    return (yy * x - xy * y) / det, (xx * y - xy * x) / det
