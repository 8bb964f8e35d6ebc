"""The lower layers of a picture: floor, place regions, drives, walls.

Where walls are known a place's region is its free floor (`projections.map.place_regions`). Else it
is all that lies within ``REACH_M`` of one of its keyframes and nearer to it than
to any other place's. It is drawn from a raster of distances to the place's keyframes. Beyond
``REACH_M`` a point is in no region, so distances are computed only around each keyframe, and the
cost of a keyframe does not grow with the sheet. They are exact up to two steps beyond, because the
outline is drawn between points on both of its sides.

Of an occupancy map, which may be far larger than the drive, the part near the drive is drawn: floor
where it is free, dark where it is occupied. Where there are more cells than the picture has room
for, several become one that is occupied if any of them is, so that no wall is lost.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.patches import PathPatch, Rectangle
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import MIN_WALL, OCCUPIED, UNKNOWN, OccupancyMap
from projections.adapters import scene
from projections.adapters.scene import Box, HousePlan, drives, place_spots
from projections.fold.occupancy import pooled
from projections.map.place_regions import place_regions
from projections.map.view import MapView

from .sheet import Extent, Sheet

REACH_M = 0.55
"""A place's region reaches this far around its keyframes."""
FAR_M = 2 * REACH_M
"""The distance given for all points outside the regions."""
_STEP_M = 0.05
_MAX_STEPS = 400

Grid = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DistancePatch:
    """Metres to the nearest of some spots, for the raster's rows and columns around them."""

    rows: slice
    columns: slice
    field: Grid


class Raster:
    """Points ``xs`` by ``ys`` of the sheet ``bounds`` (x0, y0, x1, y1), in metres."""

    def __init__(self, bounds: tuple[float, float, float, float]) -> None:
        x0, y0, x1, y1 = bounds
        self.step = max(_STEP_M, (x1 - x0) / _MAX_STEPS, (y1 - y0) / _MAX_STEPS)
        self.xs: Grid = np.arange(x0, x1, self.step)
        self.ys: Grid = np.arange(y0, y1, self.step)

    def distances(self, spots: Sequence[tuple[float, float]]) -> DistancePatch:
        """Distances to the nearest of ``spots``, FAR_M outside the regions; empty for no spots."""
        near = [(*self.around(x, y), x, y) for x, y in spots]
        rows = _hull([each[0] for each in near])
        columns = _hull([each[1] for each in near])
        field = np.full((rows.stop - rows.start, columns.stop - columns.start), FAR_M)
        for own_rows, own_columns, x, y in near:
            part = field[_within(own_rows, rows), _within(own_columns, columns)]
            to_x, to_y = self.xs[None, own_columns] - x, self.ys[own_rows, None] - y
            np.minimum(part, np.hypot(to_x, to_y), out=part)
        return DistancePatch(rows, columns, field)

    def around(self, x: float, y: float) -> tuple[slice, slice]:
        """Rows and columns of the points near enough for a keyframe there to count."""
        return self._span(self.ys, y), self._span(self.xs, x)

    def _span(self, points: Grid, middle: float) -> slice:
        reach = REACH_M + 2 * self.step
        first, last = np.searchsorted(points, (middle - reach, middle + reach))
        return slice(int(first), int(last))


def _hull(spans: Sequence[slice]) -> slice:
    start = min((span.start for span in spans), default=0)
    return slice(start, max((span.stop for span in spans), default=start))


def _within(span: slice, whole: slice) -> slice:
    return slice(span.start - whole.start, span.stop - whole.start)


def draw_floor(sheet: Sheet, plan: HousePlan) -> None:
    """Rooms and the furniture in them."""
    for _, box in plan.rooms:
        _rectangle(sheet, box, scene.FLOOR, scene.FLOOR, 0)
    for box in plan.furniture:
        _rectangle(sheet, box, scene.FURNITURE, scene.FURNITURE_EDGE, 1)


def draw_walls(sheet: Sheet, plan: HousePlan) -> None:
    """Walls, on top of the regions, which may reach a little through them."""
    for x0, y0, x1, y1 in plan.walls:
        sheet.axes.plot(
            (x0, x1), (y0, y1), color=scene.WALL, lw=3.2, solid_capstyle="projecting", zorder=7
        )
        if x0 == x1 or y0 == y1:  # labels keep off upright walls; a slanted one's box is too large
            half_x, half_y = abs(x1 - x0) / 2 + 0.03, abs(y1 - y0) / 2 + 0.03
            sheet.occupied.append(Extent((x0 + x1) / 2, (y0 + y1) / 2, half_x, half_y))


def draw_regions(sheet: Sheet, view: MapView) -> None:
    """Each place's region, in its colour."""
    regions = place_regions(view)
    for owner, region in regions.items():
        rings = [ring for rings in region.polygons for ring in rings]
        colour = scene.place_colour(owner)
        path = Path.make_compound_path(*(Path(ring, closed=True) for ring in rings))
        sheet.axes.add_patch(PathPatch(path, facecolor=colour, lw=0, alpha=0.28, zorder=2))
        sheet.axes.add_patch(PathPatch(path, facecolor="none", edgecolor=colour, lw=1.1, zorder=3))
    raster = Raster(sheet.bounds)
    patches = {
        p: raster.distances(spots) for p, spots in place_spots(view).items() if p not in regions
    }
    nearest = np.full((len(raster.ys), len(raster.xs)), np.inf)
    for patch in patches.values():
        own = nearest[patch.rows, patch.columns]
        np.minimum(own, patch.field, out=own)
    for place, patch in patches.items():
        if min(patch.field.shape) < 2:
            continue
        field = np.where(patch.field <= nearest[patch.rows, patch.columns], patch.field, FAR_M)
        grid = raster.xs[patch.columns], raster.ys[patch.rows], field
        colours = [scene.place_colour(place)]
        sheet.axes.contourf(*grid, levels=[-1.0, REACH_M], colors=colours, alpha=0.28, zorder=2)
        sheet.axes.contour(*grid, levels=[REACH_M], colors=colours, linewidths=1.1, zorder=3)


def draw_drives(sheet: Sheet, view: MapView) -> None:
    """Each run's path, where it started, and its keyframes in their places' colours."""
    for _, spots in drives(view):
        if spots:
            xs, ys = zip(*spots, strict=True)
            sheet.axes.plot(xs, ys, color=scene.FAINT, lw=0.8, alpha=0.8, zorder=4)
            sheet.axes.plot(xs[0], ys[0], marker="s", markersize=5.5, color=scene.INK, zorder=6)
    for place, spots in place_spots(view).items():
        if spots:
            xs, ys = zip(*spots, strict=True)
            sheet.axes.scatter(xs, ys, s=6, color=scene.place_colour(place), zorder=5)


def _rectangle(sheet: Sheet, box: Box, fill: str, edge: str, zorder: int) -> None:
    x0, y0, x1, y1 = box
    patch = Rectangle((x0, y0), x1 - x0, y1 - y0, facecolor=fill, edgecolor=edge, lw=0.6)
    patch.set_zorder(zorder)
    sheet.axes.add_patch(patch)


_AROUND_M: Final = 1.5
"""Walls this far from the drive make the picture larger; those beyond are drawn where they fit."""
_MOST_CELLS: Final = 1_600
"""Most cells in a row or column of the image."""

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


def draw_map_walls(sheet: Sheet, view: MapView) -> None:
    """Free floor below the places' regions, walls above them."""
    if view.map is None:
        return
    given = view.map.map
    first_row, first_column, cells = _visible(given, sheet.bounds)
    if not cells.size:
        return
    step = max(1, -(-max(cells.shape) // _MOST_CELLS))
    walls, free = pooled(_is_wall(cells), step), pooled(cells < MIN_WALL, step)
    height, width = (side * step for side in walls.shape)
    x, y, yaw = given.origin
    placed = Affine2D().translate(first_column, first_row).scale(given.resolution)
    to_map = placed.rotate(yaw).translate(x, y) + sheet.axes.transData
    limits = sheet.axes.get_xlim(), sheet.axes.get_ylim()
    for drawn, colour, zorder in ((free & ~walls, scene.FLOOR, 0.5), (walls, scene.WALL, 7)):
        image = sheet.axes.imshow(
            _image(drawn, colour),
            extent=(0.0, width, 0.0, height),
            origin="lower",
            interpolation="nearest",
            zorder=zorder,
        )
        image.set_transform(to_map)
    sheet.axes.set_xlim(limits[0])
    sheet.axes.set_ylim(limits[1])


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
    """First row, first column and cells of the part of the map inside the bounds."""
    x0, y0, x1, y1 = bounds
    x, y, yaw = given.origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = np.array([(x0, y0), (x0, y1), (x1, y0), (x1, y1)]) - (x, y)
    columns = (cos * corners[:, 0] + sin * corners[:, 1]) / given.resolution
    rows = (cos * corners[:, 1] - sin * corners[:, 0]) / given.resolution
    top, left = (max(0, int(np.floor(at.min()))) for at in (rows, columns))
    bottom, right = (max(0, int(np.ceil(at.max()))) for at in (rows, columns))
    return top, left, given.cells[top:bottom, left:right]


def _image(drawn: NDArray[np.bool_], colour: str) -> NDArray[np.float64]:
    image = np.zeros((*drawn.shape, 4))
    image[drawn] = to_rgba(colour)
    return image
