"""Pictures of several maps: a merge before and after, maps under several settings side by side, and
a run over the map that it is aligned to."""

import math
from collections.abc import Sequence
from pathlib import Path
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from eventsrc.envelope.model import Offset
from projections.adapters import scene
from projections.adapters.scene import HousePlan, drives
from projections.history.known_history import KnownHistory
from projections.history.merge_reasons import chains_of, merge_reason
from projections.history.names import keyframe_name, place_title
from projections.localize.align.alignment import Alignment
from projections.localize.align.matching import moved
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_records import Merge

from .base_layers import draw_drives, draw_map_walls, draw_regions, wall_spots
from .map_picture import draw_place_names
from .sheet import HALO, Bounds, Sheet, check_suffix, new_sheet

_PANEL_IN = 6.5
_SMALL_PANEL_IN = 4.2
_HEADER_IN = 0.6
_TITLE_IN = 0.4
_LEGEND = (
    "★ bridging keyframe    dashed: ε around it    ○ its neighbours    "
    "red: the core points that join them    ■ start of the run"
)
_ROOMS_LEGEND = (
    "★ bridging keyframe    red: the two cells with the shortest drive between them    "
    "■ start of the run"
)
_ALIGNED_LEGEND = (
    "small dots: keyframes of the frame    ● its things    blue: the drive and × the things moved "
    "into it    red: one thing"
)
_MOVED, _PAIR = "#1f6fb4", "#c0392b"
_HEADER_WIDTH = 170
"""Characters in a line of the header."""
_AROUND_EPS = 4.0
"""The least margin around the core points of a merge, in ε."""


def draw_merge(known: KnownHistory, merge: Merge, out: Path) -> None:
    """Draw the surroundings of a merge before and after it, side by side, to ``out``.

    Both show the bridging keyframe, its ε circle and the chain of core points. Raises MisuseError
    when ``out`` is not the name of a picture or cannot be written.
    """
    before, after = known.at(merge.cause.offset), known.at(Offset(merge.cause.offset + 1))
    history = known.covering(after.next_offset)
    bounds = _bounds_of_merge(history, merge)
    figure, panels = _panels(2, bounds, (2, _PANEL_IN), _HEADER_IN)
    for panel, view, when in zip(panels, (before, after), ("before", "after"), strict=True):
        _draw_map(panel, view)
        _draw_chains(panel, history, merge)
        at = view.next_offset
        names = [place_title(history, place, at) for place in merge.places]
        shown = " and ".join(names) if when == "before" else names[0]
        panel.axes.set_title(f"--at {view.next_offset}, {when}: {shown}", fontsize=10)
    header = f"merge {merge.number}, {merge.cause.when}: {merge_reason(history, merge)}"
    legend = _ROOMS_LEGEND if history.settings.places == "rooms" else _LEGEND
    figure.suptitle(f"{fill(header, _HEADER_WIDTH)}\n{legend}", fontsize=9.5)
    _save(figure, out)


def draw_maps(maps: Sequence[tuple[str, MapView]], out: Path) -> None:
    """Draw (title, map) pairs side by side, at one scale, to ``out``."""
    bounds = _bounds_of_maps([view for _, view in maps])
    columns = min(len(maps), max(2, math.ceil(math.sqrt(len(maps)))))
    figure, panels = _panels(len(maps), bounds, (columns, _SMALL_PANEL_IN), 0.0)
    for panel, (title, view) in zip(panels, maps, strict=True):
        _draw_map(panel, view)
        panel.axes.set_title(title, fontsize=8.5)
    _save(figure, out)


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
    axes.plot(*np.array([*here.values()]).T, "o", color=scene.FAINT, markersize=4, zorder=5)
    axes.plot(*into.T, "x", color=_MOVED, markersize=5, zorder=6)
    for one, other, _ in found.pairs:
        ends = np.array([here[one], there[other]])
        axes.plot(*ends.T, color=_PAIR, linewidth=1.6, zorder=7)
    sheet.header(0, title, 14, scene.INK, "bold")
    sheet.footer(0, _ALIGNED_LEGEND, scene.SMALL_PRINT)
    sheet.save(out)


def _panels(
    count: int, bounds: Bounds, layout: tuple[int, float], header_in: float
) -> tuple[Figure, list[Sheet]]:
    """A figure with ``count`` equal panels of ``bounds`` (metres x0, y0, x1, y1); ``layout`` is
    the columns and their width, ``header_in`` the space above, in inches."""
    columns, width_in = layout
    x0, y0, x1, y1 = bounds
    rows = math.ceil(count / columns)
    height_in = width_in * (y1 - y0) / (x1 - x0) + _TITLE_IN
    figure = Figure(figsize=(columns * width_in, rows * height_in + header_in), facecolor="white")
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.01, right=0.99, bottom=0.01, wspace=0.02, hspace=_TITLE_IN / height_in,
        top=1 - (header_in + _TITLE_IN) / (rows * height_in + header_in),
    )  # fmt: skip
    axes: list[Axes] = list(grid.flat)
    for each in axes:
        each.set_axis_off()
    unit = (x1 - x0) / (width_in * 72)
    return figure, [Sheet(figure, each, bounds, unit) for each in axes[:count]]


def _draw_map(panel: Sheet, view: MapView) -> None:
    x0, y0, x1, y1 = panel.bounds
    draw_regions(panel, view)
    draw_drives(panel, view)
    draw_place_names(panel, view)
    for text in panel.axes.texts:
        text.set_clip_on(True)
    panel.axes.set_xlim(x0, x1)
    panel.axes.set_ylim(y0, y1)
    panel.axes.set_aspect("equal")


def _draw_chains(panel: Sheet, history: History, merge: Merge) -> None:
    """The bridge with its ε circle and neighbours, and the chains of core points."""
    end = Offset(merge.cause.offset + 1)
    x, y = map(float, history.neighbours.positions([merge.bridge])[0])
    if history.settings.places == "rooms":
        _draw_links(panel, history, merge)
    else:
        _draw_neighbours(panel, history, merge, end)
    for chain in chains_of(history, merge):
        path = history.neighbours.positions(chain.points)
        panel.axes.plot(*path.T, color=scene.ESTIMATE, lw=2.2, marker="o", ms=5, zorder=14)
    panel.axes.scatter([x], [y], s=90, marker="*", color=scene.BRIDGE, zorder=15)
    panel.axes.annotate(
        keyframe_name(history, merge.bridge), (x, y), textcoords="offset points", xytext=(7, 7),
        fontsize=8.5, color=scene.BRIDGE, weight="bold", path_effects=HALO, zorder=16,
    )  # fmt: skip


def _draw_links(panel: Sheet, history: History, merge: Merge) -> None:
    """The founders of the cells of places by rooms that are the shortest drive apart."""
    for link in merge.links:
        ends = history.neighbours.positions([link.core, link.neighbour])
        panel.axes.plot(*ends.T, color=scene.ESTIMATE, lw=2.2, marker="o", ms=5, zorder=14)


def _draw_neighbours(panel: Sheet, history: History, merge: Merge, end: Offset) -> None:
    """The bridge's ε circle, and the keyframes in it."""
    x, y = map(float, history.neighbours.positions([merge.bridge])[0])
    circle = Circle((x, y), history.settings.eps_m, fill=False, lw=1.2, ls="--", zorder=12)
    circle.set_edgecolor(scene.BRIDGE)
    panel.axes.add_patch(circle)
    near = history.neighbours.positions(history.neighbours.of(merge.bridge, end))
    panel.axes.scatter(
        near[:, 0], near[:, 1], s=26, facecolor="none", edgecolor=scene.BRIDGE, lw=0.9, zorder=12
    )


def _bounds_of_merge(history: History, merge: Merge) -> Bounds:
    """A square around the bridge and the core points that join the places."""
    points = [merge.bridge, *(k for chain in chains_of(history, merge) for k in chain.points)]
    if history.settings.places == "rooms":
        points += (k for link in merge.links for k in (link.core, link.neighbour))
    spots = history.neighbours.positions(points)
    (x0, y0), (x1, y1) = spots.min(axis=0), spots.max(axis=0)
    x, y = float(x0 + x1) / 2, float(y0 + y1) / 2
    settings = history.settings
    margin = settings.rooms.drive_m if settings.places == "rooms" else _AROUND_EPS * settings.eps_m
    half = float(max(x1 - x0, y1 - y0)) / 2 + margin
    return x - half, y - half, x + half, y + half


def _bounds_of_maps(views: Sequence[MapView]) -> Bounds:
    poses = [k.pose for view in views for k in view.keyframes if k.pose is not None]
    if not poses:
        return (-1.0, -1.0, 1.0, 1.0)
    xs, ys = [p.x_m for p in poses], [p.y_m for p in poses]
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    margin = 0.05 * max(x1 - x0, y1 - y0, 1.0) + 0.6
    return x0 - margin, y0 - margin, x1 + margin, y1 + margin


def _save(figure: Figure, out: Path) -> None:
    check_suffix(out)
    Sheet(figure, figure.axes[0], (0, 0, 1, 1), 1.0).save(out)
