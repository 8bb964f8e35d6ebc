"""The occupancy map in a picture: floor where it is free, dark where it is occupied.

The map of a whole building may be far larger than the drive: what is near it is drawn, and where
there are more cells than the picture has room for, a few become one that is occupied if any of them
is, so that no wall is lost.
"""

from typing import Final

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from eventsrc.occupancy_map import MIN_WALL, OCCUPIED, UNKNOWN, OccupancyMap
from projections import palette
from projections.model.view import MapView

from .canvas import Canvas
from .scene import drives

_AROUND_M: Final = 1.5
"""Walls this far from the drive make the picture larger; those beyond are drawn where they fit."""
_MOST_CELLS: Final = 1_600
"""In a row or column of the image."""

Spots = list[tuple[float, float]]


def wall_spots(view: MapView) -> Spots:
    """Corners of the walls near the drive, which the picture must have room for."""
    poses = np.array([spot for _, drive in drives(view) for spot in drive]).reshape(-1, 2)
    if view.map is None:
        return []
    given = view.map.map
    rows, columns = np.nonzero(_is_wall(given.cells))
    if not len(rows):
        return []
    at = _in_map_frame(given, columns, rows)
    if len(poses):
        low, high = poses.min(axis=0) - _AROUND_M, poses.max(axis=0) + _AROUND_M
        at = at[((at >= low) & (at <= high)).all(axis=1)]
    if not len(at):
        return []
    return [(corner[0], corner[1]) for corner in (at.min(axis=0).tolist(), at.max(axis=0).tolist())]


def draw_map_walls(canvas: Canvas, view: MapView) -> None:
    """Free floor below the places' regions, walls above them."""
    if view.map is None:
        return
    given = view.map.map
    first_row, first_column, cells = _visible(given, canvas.bounds)
    if not cells.size:
        return
    step = max(1, -(-max(cells.shape) // _MOST_CELLS))
    walls, free = _pooled(_is_wall(cells), step), _pooled(cells < MIN_WALL, step)
    height, width = (side * step for side in walls.shape)
    x, y, yaw = given.origin
    placed = Affine2D().translate(first_column, first_row).scale(given.resolution)
    to_map = placed.rotate(yaw).translate(x, y) + canvas.axes.transData
    limits = canvas.axes.get_xlim(), canvas.axes.get_ylim()
    for drawn, colour, zorder in ((free & ~walls, palette.FLOOR, 0.5), (walls, palette.WALL, 7)):
        image = canvas.axes.imshow(
            _image(drawn, colour),
            extent=(0.0, width, 0.0, height),
            origin="lower",
            interpolation="nearest",
            zorder=zorder,
        )
        image.set_transform(to_map)
    canvas.axes.set_xlim(limits[0])
    canvas.axes.set_ylim(limits[1])


def _is_wall(cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
    walls: NDArray[np.bool_] = (cells >= MIN_WALL) & (cells <= OCCUPIED) & (cells != UNKNOWN)
    return walls


def _in_map_frame(
    given: OccupancyMap, columns: NDArray[np.int64], rows: NDArray[np.int64]
) -> NDArray[np.float64]:
    """x and y in metres of the middles of cells, shape (n, 2)."""
    x, y, yaw = given.origin
    u, v = (columns + 0.5) * given.resolution, (rows + 0.5) * given.resolution
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=1)


def _visible(
    given: OccupancyMap, bounds: tuple[float, float, float, float]
) -> tuple[int, int, NDArray[np.uint8]]:
    """First row, first column and cells of the part of the map that lies in the bounds."""
    x0, y0, x1, y1 = bounds
    x, y, yaw = given.origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = np.array([(x0, y0), (x0, y1), (x1, y0), (x1, y1)]) - (x, y)
    columns = (cos * corners[:, 0] + sin * corners[:, 1]) / given.resolution
    rows = (cos * corners[:, 1] - sin * corners[:, 0]) / given.resolution
    top, left = (max(0, int(np.floor(at.min()))) for at in (rows, columns))
    bottom, right = (max(0, int(np.ceil(at.max()))) for at in (rows, columns))
    return top, left, given.cells[top:bottom, left:right]


def _pooled(cells: NDArray[np.bool_], step: int) -> NDArray[np.bool_]:
    """True where any of ``step`` by ``step`` cells is."""
    rows, columns = cells.shape
    padded = np.pad(cells, ((0, -rows % step), (0, -columns % step)))
    shape = padded.shape[0] // step, step, padded.shape[1] // step, step
    return np.asarray(padded.reshape(shape).any(axis=(1, 3)))


def _image(drawn: NDArray[np.bool_], colour: str) -> NDArray[np.float64]:
    image = np.zeros((*drawn.shape, 4))
    image[drawn] = to_rgba(colour)
    return image
