"""Draw the map of a run over another one, with the things that both have."""

from pathlib import Path

import numpy as np

from projections.adapters import palette
from projections.adapters.scene import HousePlan, drives
from projections.localize.align import Alignment, moved
from projections.map.view import MapView

from .base_layers import draw_drives, draw_map_walls, wall_spots
from .sheet import check_suffix, new_sheet

_LEGEND = (
    "small dots: keyframes of the frame    ● its things    blue: the drive and × the things moved "
    "into it    red: one thing"
)
_MOVED, _PAIR = "#1f6fb4", "#c0392b"


def draw_alignment(
    first: MapView, second: MapView, found: Alignment, out: Path, title: str
) -> None:
    """Draw ``second``, moved into the frame of ``first``, over it, to ``out``. Raises MisuseError
    when ``out`` is not the name of a picture or cannot be written."""
    check_suffix(out)
    here, own = (
        {each.object_id: each.spot for each in view.objects.values()} for view in (first, second)
    )
    into = moved(np.array([*own.values()]), found.transform)
    there = dict(zip(own, into.tolist(), strict=True))
    ways = [moved(np.array(way), found.transform) for _, way in drives(second)]
    spots = [*here.values(), *there.values(), *(point for way in ways for point in way.tolist())]
    sheet = new_sheet(first, HousePlan(), [*spots, *wall_spots(first)])
    draw_map_walls(sheet, first)
    draw_drives(sheet, first)
    axes = sheet.axes
    for way in ways:
        axes.plot(*way.T, color=_MOVED, linewidth=0.8, alpha=0.6)
    axes.plot(*np.array([*here.values()]).T, "o", color=palette.FAINT, markersize=4, zorder=5)
    axes.plot(*into.T, "x", color=_MOVED, markersize=5, zorder=6)
    for one, other, _ in found.pairs:
        ends = np.array([here[one], there[other]])
        axes.plot(*ends.T, color=_PAIR, linewidth=1.6, zorder=7)
    sheet.header(0, title, 14, palette.INK, "bold")
    sheet.footer(0, _LEGEND, palette.SMALL_PRINT)
    sheet.save(out)
