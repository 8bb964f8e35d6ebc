"""The region of each place: the free floor that is nearer by way to its keyframes than to those of
any other (`projections.fold.free_floor`); where walls are known and places use them.

A region is given as a GeoJSON geometry in metres of the map frame: its outline along the borders of
cells, with holes. Outer rings run counter-clockwise, holes clockwise; a ring touches itself or
another one in single points only.

Walls are line segments: the outline of a map's occupied cells, a straight one a segment. Where a
map has more than `MOST_SEGMENTS`, cells are pooled: a square of them is occupied if one of them is,
so that no wall is lost.
"""

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import PlaceOrdinal
from projections.fold.exact import UM_PER_M
from projections.fold.free_floor import FreeFloor, free_floor
from projections.fold.map_regions import NOWHERE
from projections.fold.occupancy import occupied, pooled

from .view import MapView

_Corner: TypeAlias = tuple[int, int]
"""Column and row of the lower left corner of a block."""
_Ring: TypeAlias = list[_Corner]
Ring: TypeAlias = tuple[tuple[float, float], ...]
"""A closed outline, in metres; the last point is the first one."""
_DECIMALS: Final = 3


@dataclass(frozen=True, slots=True)
class Region:
    """A place's free floor: per part its outer ring, then its holes; and its area."""

    polygons: tuple[tuple[Ring, ...], ...]
    area_m2: float

    def geometry(self) -> dict[str, Any]:
        """The GeoJSON geometry: a Polygon, or a MultiPolygon where there are several parts."""
        parts = [[[list(point) for point in ring] for ring in rings] for rings in self.polygons]
        if len(parts) == 1:
            return {"type": "Polygon", "coordinates": parts[0]}
        return {"type": "MultiPolygon", "coordinates": parts}

    def document(self) -> dict[str, Any]:
        """As JSON: the ``region`` and its ``area_m2``."""
        return {"region": self.geometry(), "area_m2": self.area_m2}

    def geometry_text(self) -> str:
        """The geometry as compact JSON, for formats whose values are texts."""
        return json.dumps(self.geometry(), separators=(",", ":"))


def place_regions(view: MapView) -> dict[PlaceOrdinal, Region]:
    """The regions of the places that have one, by ordinal; ten to a hundred milliseconds."""
    found: dict[PlaceOrdinal, Region] = {}
    if view.settings.places != "rooms":
        return found
    for floor, given in view.maps_in_force().items():
        ground = free_floor(given.map)
        blocks, places = list[int](), list[PlaceOrdinal]()
        for keyframe in view.keyframes:
            if keyframe.pose is None or keyframe.joined is None or keyframe.floor != floor:
                continue
            block = ground.block_at((keyframe.pose.x_um, keyframe.pose.y_um))
            if block is not None:
                blocks.append(block)
                places.append(view.survivors.find(keyframe.joined))
        if blocks:
            owners = ground.owners(blocks)
            owned = owners != NOWHERE
            owners[owned] = np.array(places, np.int64)[owners[owned]]
            found |= _regions(ground, owners.reshape(ground.shape))
    return dict(sorted(found.items()))


def _regions(ground: FreeFloor, places: NDArray[np.int64]) -> Mapping[PlaceOrdinal, Region]:
    """The regions of one floor, of the place of each block."""
    found = {}
    for place in np.unique(places[places != NOWHERE]).tolist():
        rows, columns = np.nonzero(places == place)
        first_row, first_column = int(rows.min()), int(columns.min())
        part = places[first_row : rows.max() + 1, first_column : columns.max() + 1] == place
        polygons = [
            [[(x + first_column - 1, y + first_row - 1) for x, y in ring] for ring in rings]
            for rings in outlines(part)
        ]
        found[PlaceOrdinal(place)] = _region(ground, polygons, rows, columns)
    return found


def _region(
    ground: FreeFloor,
    polygons: Iterable[Iterable[_Ring]],
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
) -> Region:
    """A region in metres, of outlines and blocks. Blocks at the edge of a map may be cut off."""
    grid, block = ground.grid, ground.grid.block
    height, width = grid.walls.shape

    def placed(corner: _Corner) -> tuple[float, float]:
        x, y = grid.in_map(min(corner[0] * block, width), min(corner[1] * block, height))
        return round(x / UM_PER_M, _DECIMALS), round(y / UM_PER_M, _DECIMALS)

    tall = np.minimum(rows * block, height) - (rows - 1) * block
    wide = np.minimum(columns * block, width) - (columns - 1) * block
    area_um2 = int((tall * wide).sum()) * grid.side_um**2
    closed = tuple(
        tuple((*map(placed, ring), placed(ring[0])) for ring in rings) for rings in polygons
    )
    return Region(closed, round(area_um2 / UM_PER_M**2, _DECIMALS))


def outlines(mask: NDArray[np.bool_]) -> list[list[_Ring]]:
    """The outlines of blocks that are true, a list for each part: its outer ring, then its holes.
    Blocks that touch at a corner only are no part. Rings have their turning points only."""
    rings = [simple for ring in _traced(mask) for simple in _simple(ring)]
    outer = sorted((ring for ring in rings if _area2(ring) > 0), key=lambda ring: min(ring)[::-1])
    parts = [[_turns(ring)] for ring in outer]
    for hole in (ring for ring in rings if _area2(ring) < 0):
        inside = [part for part in parts if _is_in(hole, part[0])]
        min(inside, key=lambda part: _area2(part[0])).append(_turns(hole))
    return parts


def _traced(mask: NDArray[np.bool_]) -> list[_Ring]:
    """The closed ways along the borders of blocks, with the blocks on their left. Where two cross
    they turn left."""
    framed = np.pad(mask, 1)
    ways: dict[_Corner, list[_Corner]] = {}
    # Below, above, left of and right of a block: its border, with the block on the left.
    for beside, start, step in (
        (framed[:-2, 1:-1], (0, 0), (1, 0)),
        (framed[2:, 1:-1], (1, 1), (-1, 0)),
        (framed[1:-1, :-2], (0, 1), (0, -1)),
        (framed[1:-1, 2:], (1, 0), (0, 1)),
    ):
        for row, column in np.argwhere(mask & ~beside).tolist():
            ways.setdefault((column + start[0], row + start[1]), []).append(step)
    rings = []
    for first in sorted(ways):
        while ways[first]:
            ring, at, step = list[_Corner](), first, ways[first][0]
            while ways[at]:
                left = (-step[1], step[0])
                step = left if left in ways[at] else ways[at][0]
                ways[at].remove(step)
                ring.append(at)
                at = at[0] + step[0], at[1] + step[1]
            rings.append(ring)
    return rings


def _simple(ring: _Ring) -> list[_Ring]:
    """A ring cut where it touches itself."""
    rings, open_, at = list[_Ring](), _Ring(), dict[_Corner, int]()
    for corner in ring:
        if corner in at:
            first = at[corner]
            rings.append(open_[first:])
            for left in open_[first:]:
                del at[left]
            del open_[first:]
        at[corner] = len(open_)
        open_.append(corner)
    return [*rings, open_]


def _area2(ring: _Ring) -> int:
    """Twice the area of a ring, negative where it runs clockwise."""
    return sum(
        ax * by - bx * ay for (ax, ay), (bx, by) in zip(ring, ring[1:] + ring[:1], strict=True)
    )


def _turns(ring: _Ring) -> _Ring:
    """The corners at which a ring turns."""
    return [
        (x, y)
        for (ax, ay), (x, y), (bx, by) in zip(
            ring[-1:] + ring[:-1], ring, ring[1:] + ring[:1], strict=True
        )
        if (x - ax) * (by - y) != (y - ay) * (bx - x)
    ]


def _is_in(hole: _Ring, ring: _Ring) -> bool:
    """Whether the middle of the block on the left of a hole's first edge is within a ring."""
    (ax, ay), (bx, by) = hole[0], hole[1]
    x, y = ax + bx - (by - ay), ay + by + (bx - ax)  # doubled
    crossed = sum(
        1
        for (cx, cy), (_, dy) in zip(ring, ring[1:] + ring[:1], strict=True)
        if 2 * cx > x and min(cy, dy) * 2 < y < max(cy, dy) * 2
    )
    return crossed % 2 == 1


MOST_SEGMENTS: Final = 20_000
_Mask = NDArray[np.bool_]


@lru_cache(maxsize=8)
def wall_segments(given: OccupancyMap) -> list[list[float]]:
    """The segments: x and y of both ends, in metres in the map frame, to the millimetre."""
    walls = occupied(given)
    step = 1
    while True:
        mask = pooled(walls, step)
        across, along = _wall_ends(mask), _wall_ends(mask.T)
        # A segment has two turns. They are counted first: a noisy map has millions of segments.
        if np.count_nonzero(across) + np.count_nonzero(along) <= 2 * MOST_SEGMENTS:
            ends = np.concatenate([_wall_lines(across), _wall_lines(along)[..., ::-1]])
            return _lines_in_map(given, ends * step * given.resolution)
        step *= 2


def _wall_ends(mask: _Mask) -> _Mask:
    """The corners of cells at which horizontal parts of the outline begin or end."""
    framed = np.pad(mask, ((1, 1), (0, 0)))
    edges = np.pad(framed[1:] != framed[:-1], ((0, 0), (1, 1)))
    return np.asarray(edges[:, 1:] != edges[:, :-1])


def _wall_lines(turns: _Mask) -> NDArray[np.intp]:
    """(column, row) of both ends of each; the turns of a row come in pairs, begin and end."""
    rows, columns = np.nonzero(turns)
    return np.stack([columns, rows], axis=-1).reshape(-1, 2, 2)


def _lines_in_map(given: OccupancyMap, ends: NDArray[Any]) -> list[list[float]]:
    x, y, yaw = given.origin
    cos, sin = np.cos(yaw), np.sin(yaw)
    u, v = ends[..., 0], ends[..., 1]
    placed = np.stack([x + cos * u - sin * v, y + sin * u + cos * v], axis=-1)
    found: list[list[float]] = np.round(placed.reshape(-1, 4), 3).tolist()
    return found
