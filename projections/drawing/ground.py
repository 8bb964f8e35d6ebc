"""The lower layers: floor, place regions, drives, walls.

A place's region is all that lies within ``REACH_M`` of one of its keyframes and nearer to it than
to any other place's.
"""

import numpy as np
from matplotlib.patches import Rectangle

from projections.view import MapView

from . import palette
from .canvas import Canvas
from .labels import Extent
from .raster import FAR_M, REACH_M, Raster
from .scene import Box, Floor, drives, place_spots


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
    raster = Raster(canvas.bounds)
    patches = {p: raster.distances(spots) for p, spots in place_spots(view).items()}
    nearest = np.full((len(raster.ys), len(raster.xs)), np.inf)
    for patch in patches.values():
        own = nearest[patch.rows, patch.columns]
        np.minimum(own, patch.field, out=own)
    for place, patch in patches.items():
        if min(patch.field.shape) < 2:
            continue
        field = np.where(patch.field <= nearest[patch.rows, patch.columns], patch.field, FAR_M)
        sheet = raster.xs[patch.columns], raster.ys[patch.rows], field
        colours = [palette.place_colour(place)]
        canvas.axes.contourf(*sheet, levels=[-1.0, REACH_M], colors=colours, alpha=0.28, zorder=2)
        canvas.axes.contour(*sheet, levels=[REACH_M], colors=colours, linewidths=1.1, zorder=3)


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
