"""Pictures of time travel: a merge before and after, and maps under several settings side by side.

Built of `projections.drawing`'s layers, one small sheet per map in one figure.
"""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from eventsrc.envelope import Offset
from projections.drawing import canvas as palette
from projections.drawing.base_layers import draw_drives, draw_regions
from projections.drawing.canvas import HALO, Bounds, Canvas, check_suffix
from projections.drawing.overlays import draw_place_names
from projections.model.view import MapView

from .merges import chains_of, reason
from .records import Merge
from .story import keyframe_name, place_name
from .timeline import Timeline

_PANEL_IN = 6.5
_SMALL_PANEL_IN = 4.2
_HEAD_IN = 0.6
_TITLE_IN = 0.4
_LEGEND = (
    "★ bridging keyframe    dashed: ε around it    ○ its neighbours    "
    "red: the core points that join them    ■ start of the run"
)
_AROUND_EPS = 4.0
"""How many ε around the bridge a merge's picture shows at least."""


def draw_merge(timeline: Timeline, merge: Merge, out: Path) -> None:
    """The merge's surroundings just before and just after it, side by side, to ``out``.

    On both: the bridging keyframe, its ε circle, the core points that met. Raises MisuseError when
    ``out`` is no picture's name or cannot be written.
    """
    before, after = timeline.at(merge.cause.offset), timeline.at(Offset(merge.cause.offset + 1))
    bounds = _around(timeline, merge)
    figure, panels = _sheet(2, bounds, (2, _PANEL_IN), _HEAD_IN)
    for panel, view, when in zip(panels, (before, after), ("before", "after"), strict=True):
        _panel(panel, view)
        _draw_links(panel, timeline, merge)
        names = [place_name(timeline.history, place) for place in merge.places]
        said = " and ".join(names) if when == "before" else names[0]
        panel.axes.set_title(f"--at {view.next_offset}, {when}: {said}", fontsize=10)
    history = timeline.history
    head = f"merge {merge.number}, {merge.cause.when}: {reason(history, merge)}"
    figure.suptitle(f"{head}\n{_LEGEND}", fontsize=9.5)
    _save(figure, out)


def draw_maps(maps: Sequence[tuple[str, MapView]], out: Path) -> None:
    """Maps of one log under several settings, each with its title, side by side."""
    bounds = _whole([view for _, view in maps])
    columns = min(len(maps), max(2, math.ceil(math.sqrt(len(maps)))))
    figure, panels = _sheet(len(maps), bounds, (columns, _SMALL_PANEL_IN), 0.0)
    for panel, (title, view) in zip(panels, maps, strict=True):
        _panel(panel, view)
        panel.axes.set_title(title, fontsize=8.5)
    _save(figure, out)


def _sheet(
    count: int, bounds: Bounds, layout: tuple[int, float], head_in: float
) -> tuple[Figure, list[Canvas]]:
    """A figure with ``count`` equal panels of ``bounds`` (metres x0, y0, x1, y1); ``layout`` is
    the columns and their width, ``head_in`` the space above, in inches."""
    columns, width_in = layout
    x0, y0, x1, y1 = bounds
    rows = math.ceil(count / columns)
    height_in = width_in * (y1 - y0) / (x1 - x0) + _TITLE_IN
    figure = Figure(figsize=(columns * width_in, rows * height_in + head_in), facecolor="white")
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.01, right=0.99, bottom=0.01, wspace=0.02, hspace=_TITLE_IN / height_in,
        top=1 - (head_in + _TITLE_IN) / (rows * height_in + head_in),
    )  # fmt: skip
    axes: list[Axes] = list(grid.flat)
    for each in axes:
        each.set_axis_off()
    unit = (x1 - x0) / (width_in * 72)
    return figure, [Canvas(figure, each, bounds, unit) for each in axes[:count]]


def _panel(panel: Canvas, view: MapView) -> None:
    x0, y0, x1, y1 = panel.bounds
    draw_regions(panel, view)
    draw_drives(panel, view)
    draw_place_names(panel, view)
    for text in panel.axes.texts:
        text.set_clip_on(True)
    panel.axes.set_xlim(x0, x1)
    panel.axes.set_ylim(y0, y1)
    panel.axes.set_aspect("equal")


def _draw_links(panel: Canvas, timeline: Timeline, merge: Merge) -> None:
    """The bridge with its ε circle and neighbours, and the core points that met."""
    history, end = timeline.history, Offset(merge.cause.offset + 1)
    x, y = map(float, history.neighbours.spots([merge.bridge])[0])
    circle = Circle((x, y), timeline.settings.eps_m, fill=False, lw=1.2, ls="--", zorder=12)
    circle.set_edgecolor(palette.BRIDGE)
    panel.axes.add_patch(circle)
    near = history.neighbours.spots(history.neighbours.of(merge.bridge, end))
    panel.axes.scatter(
        near[:, 0], near[:, 1], s=26, facecolor="none", edgecolor=palette.BRIDGE, lw=0.9, zorder=12
    )
    for chain in chains_of(history, merge):
        path = history.neighbours.spots(chain.points)
        panel.axes.plot(*path.T, color=palette.ESTIMATE, lw=2.2, marker="o", ms=5, zorder=14)
    panel.axes.scatter([x], [y], s=90, marker="*", color=palette.BRIDGE, zorder=15)
    panel.axes.annotate(
        keyframe_name(history, merge.bridge), (x, y), textcoords="offset points", xytext=(7, 7),
        fontsize=8.5, color=palette.BRIDGE, weight="bold", path_effects=HALO, zorder=16,
    )  # fmt: skip


def _around(timeline: Timeline, merge: Merge) -> Bounds:
    """A square around the bridge and the core points that join the places."""
    history = timeline.history
    points = [merge.bridge, *(k for chain in chains_of(history, merge) for k in chain.points)]
    spots = history.neighbours.spots(points)
    (x0, y0), (x1, y1) = spots.min(axis=0), spots.max(axis=0)
    x, y = float(x0 + x1) / 2, float(y0 + y1) / 2
    half = float(max(x1 - x0, y1 - y0)) / 2 + _AROUND_EPS * timeline.settings.eps_m
    return x - half, y - half, x + half, y + half


def _whole(views: Sequence[MapView]) -> Bounds:
    poses = [k.pose for view in views for k in view.keyframes if k.pose is not None]
    if not poses:
        return (-1.0, -1.0, 1.0, 1.0)
    xs, ys = [p.x_m for p in poses], [p.y_m for p in poses]
    x0, y0, x1, y1 = min(xs), min(ys), max(xs), max(ys)
    margin = 0.05 * max(x1 - x0, y1 - y0, 1.0) + 0.6
    return x0 - margin, y0 - margin, x1 + margin, y1 + margin


def _save(figure: Figure, out: Path) -> None:
    check_suffix(out)
    Canvas(figure, figure.axes[0], (0, 0, 1, 1), 1.0).save(out)
