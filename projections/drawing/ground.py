"""The lower layers: floor, place regions, drives, walls.

A place's region is all that lies within ``_REACH_M`` of one of its keyframes and nearer to it than
to any other place's.
"""

import numpy as np
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from projections.view import MapView

from . import palette
from .canvas import Canvas
from .labels import Extent
from .scene import Box, Floor, drives, place_spots

_REACH_M = 0.55
_STEP_M = 0.05
_MAX_STEPS = 400

Grid = NDArray[np.float64]


def draw_floor(canvas: Canvas, floor: Floor) -> None:
    """Rooms and the furniture in them."""
    for _, box in floor.rooms:
        _rectangle(canvas, box, palette.FLOOR, palette.FLOOR, 0)
    for box in floor.furniture:
        _rectangle(canvas, box, palette.FURNITURE, palette.FURNITURE_EDGE, 1)


def draw_walls(canvas: Canvas, floor: Floor) -> None:
    """Walls, on top of the regions that may reach a little through them."""
    for x0, y0, x1, y1 in floor.walls:
        canvas.axes.plot(
            (x0, x1), (y0, y1), color=palette.WALL, lw=3.2, solid_capstyle="projecting", zorder=7
        )
        if x0 == x1 or y0 == y1:  # text keeps off upright walls; a slanted one's box is too much
            half_x, half_y = abs(x1 - x0) / 2 + 0.03, abs(y1 - y0) / 2 + 0.03
            canvas.taken.append(Extent((x0 + x1) / 2, (y0 + y1) / 2, half_x, half_y))


def draw_regions(canvas: Canvas, view: MapView) -> None:
    """What each place covers, in its colour."""
    x0, y0, x1, y1 = canvas.bounds
    step = max(_STEP_M, (x1 - x0) / _MAX_STEPS, (y1 - y0) / _MAX_STEPS)
    xs, ys = np.arange(x0, x1, step), np.arange(y0, y1, step)
    spots = {place: s for place, s in place_spots(view).items() if s}
    nearest = np.full((len(ys), len(xs)), np.inf)
    for own in spots.values():
        nearest = np.minimum(nearest, _distances(own, xs, ys))
    for place, own in spots.items():
        field = _distances(own, xs, ys)
        field = np.where(field <= nearest, field, 2 * _REACH_M)
        colour = palette.place_colour(place)
        canvas.axes.contourf(
            xs, ys, field, levels=[-1.0, _REACH_M], colors=[colour], alpha=0.28, zorder=2
        )
        canvas.axes.contour(
            xs, ys, field, levels=[_REACH_M], colors=[colour], linewidths=1.1, zorder=3
        )


def draw_drives(canvas: Canvas, view: MapView) -> None:
    """Each run's way, where it started, and its keyframes in their places' colours."""
    for _, spots in drives(view):
        if spots:
            xs, ys = zip(*spots, strict=True)
            canvas.axes.plot(xs, ys, color=palette.FAINT, lw=0.8, alpha=0.8, zorder=4)
            canvas.axes.plot(xs[0], ys[0], marker="s", markersize=5.5, color=palette.INK, zorder=6)
    for place, spots in place_spots(view).items():
        if spots:
            xs, ys = zip(*spots, strict=True)
            canvas.axes.scatter(xs, ys, s=6, color=palette.place_colour(place), zorder=5)


def _rectangle(canvas: Canvas, box: Box, fill: str, edge: str, zorder: int) -> None:
    x0, y0, x1, y1 = box
    patch = Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=fill, edgecolor=edge, lw=0.6)
    patch.set_zorder(zorder)
    canvas.axes.add_patch(patch)


def _distances(spots: list[tuple[float, float]], xs: Grid, ys: Grid) -> Grid:
    """Distance of every grid point to the nearest of ``spots``; shape (len(ys), len(xs))."""
    nearest: Grid = np.full((len(ys), len(xs)), np.inf)
    for x, y in spots:
        nearest = np.minimum(nearest, np.hypot(xs[None, :] - x, ys[:, None] - y))
    return nearest
