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

    ``along`` and ``across`` (n,) are their standard errors in and square to the ray's direction.
    """

    at: Floats
    ray: Floats
    along: Floats
    across: Floats

    @property
    def ahead(self) -> tuple[Floats, Floats]:
        """Unit vectors of the rays, x and y; a ray of no length counts as one along x."""
        length = np.sqrt(self.ray[:, 0] ** 2 + self.ray[:, 1] ** 2)
        safe = np.where(length > 0, length, 1.0)
        return np.where(length > 0, self.ray[:, 0] / safe, 1.0), self.ray[:, 1] / safe

    def of(self, index: Indices) -> "Points":
        """Those at ``index``."""
        return Points(self.at[index], self.ray[index], self.along[index], self.across[index])


def points_of(origin: Floats, ray: Floats, cut: Flags, sigma_size: float, model: Model) -> Points:
    """Points at the ends of the rays; ``cut`` marks boxes that are cut off or missing."""
    reach = _reach(ray)
    depth = np.where(cut, model.map_log_depth_cut, model.map_log_depth)
    bearing = np.where(cut, model.map_bearing_cut, model.map_bearing)
    along = np.sqrt(depth * depth + sigma_size**2) * reach + model.map_least
    return Points(origin + ray, ray, along, bearing * reach + model.map_least)


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
    xx, xy, yy = _information(points, pull)
    x, y = _solve(xx, xy, yy, points.at)
    sxx, sxy, syy = float(xx.sum()), float(xy.sum()), float(yy.sum())
    det, least = sxx * syy - sxy * sxy, model.sigma_landmark**2
    spread = (syy / det + least, -sxy / det, sxx / det + least)
    return Settled(x, y, spread, _solve(xx, xy, yy, points.ray))


def _reach(ray: Floats) -> Floats:
    reach: Floats = np.maximum(np.sqrt(ray[:, 0] ** 2 + ray[:, 1] ** 2), _LEAST_REACH_M)
    return reach


def _misfit(points: Points, to: Floats) -> Floats:
    """χ² of each point being at ``to``, of shape (2,) or (m, 1, 2)."""
    ux, uy = points.ahead
    dx, dy = to[..., 0] - points.at[:, 0], to[..., 1] - points.at[:, 1]
    along, across = (dx * ux + dy * uy) / points.along, (dy * ux - dx * uy) / points.across
    chi: Floats = along * along + across * across
    return chi


def _information(points: Points, weight: Floats) -> tuple[Floats, Floats, Floats]:
    ux, uy = points.ahead
    along, across = weight / points.along**2, weight / points.across**2
    return (
        along * ux * ux + across * uy * uy,
        (along - across) * ux * uy,
        along * uy * uy + across * ux * ux,
    )


def _mean(points: Points, weight: Floats) -> tuple[float, float]:
    return _solve(*_information(points, weight), points.at)


def _solve(xx: Floats, xy: Floats, yy: Floats, vectors: Floats) -> tuple[float, float]:
    """The mean of ``vectors`` weighted by 2 × 2 information matrices."""
    sxx, sxy, syy = float(xx.sum()), float(xy.sum()), float(yy.sum())
    bx = float((xx * vectors[:, 0] + xy * vectors[:, 1]).sum())
    by = float((xy * vectors[:, 0] + yy * vectors[:, 1]).sum())
    det = sxx * syy - sxy * sxy
    return (syy * bx - sxy * by) / det, (sxx * by - sxy * bx) / det
