"""A map's picture: layers from the floor up, fixed text before labels that can be moved.

Objects are drawn at their estimated position under fusion by evidence; else at the mean position of
the *robot* when it saw them. Their labels are moved to stay legible, and a thin line leads back.
Each text adds its box to the sheet's occupied ones, so that later and less important labels keep
clear of it.
"""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, overload

from matplotlib.patches import Circle, Ellipse

from eventsrc.base.text import counted
from eventsrc.envelope.grey_images import with_few_colours
from projections.adapters import scene
from projections.fold.deltas import PlacesMerged
from projections.map.records import ObjectRecord, objects_text
from projections.map.view import MapView
from projections.store.history_records import Merge

from . import base_layers
from .sheet import HALO, Extent, LabelRequest, Sheet, check_suffix, new_sheet, place_labels

DOT_M = 0.04
"""Half the size of the box that an object's dot occupies."""
_LABEL_PT = 8.0
_WIDE_M = 2.0
"""Ellipses wider than this are drawn faintly."""
_RINGS_M = tuple(0.07 * 1.28**step for step in range(15))


def draw_adjacency(sheet: Sheet, view: MapView) -> None:
    """A dashed line between neighbouring places and the number of transitions on it; a dotted one
    between two floors."""
    for a, b, count in view.edges():
        one, other = view.places[a], view.places[b]
        start, end = (one.centroid_x, one.centroid_y), (other.centroid_x, other.centroid_y)
        dashes = (1, 2) if view.is_between_floors(a, b) else (4, 3)
        line = {"arrowstyle": "-", "color": scene.INK, "lw": 1.2, "ls": (0, dashes)}
        sheet.axes.annotate("", end, start, zorder=8, arrowprops=line)
        middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        _draw_badge(
            sheet, middle, str(count), 7.5, ("white", scene.INK, scene.INK), "round,pad=0.2"
        )


def draw_place_names(sheet: Sheet, view: MapView) -> None:
    """Each place's name on its centroid, in its colour, with its likely type."""
    names = scene.place_badges(view)
    for ordinal, place in view.places.items():
        centroid = place.centroid_x, place.centroid_y
        colours = scene.place_colour(ordinal), "white", "white"
        _draw_badge(sheet, centroid, names[ordinal], 10, colours, "round,pad=0.3,rounding_size=0.9")


def draw_room_names(sheet: Sheet, plan: scene.HousePlan) -> None:
    """Each room's name, in the first of its corners that is free."""
    height = 12 * sheet.unit
    for name, (x0, y0, x1, y1) in plan.rooms:
        width = 5.6 * len(name) * sheet.unit
        dx, dy = width / 2 + 0.14, height / 2 + 0.1
        corners = ((x0 + dx, y1 - dy), (x1 - dx, y1 - dy), (x0 + dx, y0 + dy), (x1 - dx, y0 + dy))
        boxes = [Extent(x, y, width / 2, height / 2) for x, y in corners]
        free = [box for box in boxes if not any(box.overlaps(other) for other in sheet.occupied)]
        _draw_text(sheet, (free or boxes)[0], name, 9.5, scene.ROOM_NAME, style="italic")


def draw_objects(sheet: Sheet, objects: Iterable[ObjectRecord]) -> int:
    """A dot for each object, a label for each group; returns how many labels did not fit."""
    groups = scene.object_groups(objects)
    for group in groups:
        colour = scene.INK if group.place is None else scene.place_colour(group.place)
        xs, ys = zip(*(member.spot for member in group.members), strict=True)
        face, edge = ("white", colour) if group.missing else (colour, "white")
        width = 1.1 if group.missing else 0.6
        sheet.axes.scatter(
            xs, ys, s=15, marker="D", facecolor=face, edgecolor=edge, lw=width, zorder=10
        )
        for member in group.members:
            _draw_evidence(sheet, member, colour)
        sheet.occupied += (Extent(x, y, DOT_M, DOT_M) for x, y in zip(xs, ys, strict=True))
    requests = [_label_request(sheet, group.label, group.spot) for group in groups]
    boxes = place_labels(requests, sheet.occupied, sheet.bounds, _RINGS_M)
    for group, box in zip(groups, boxes, strict=True):
        if box is not None:
            _draw_leader(sheet, group.spot, box)
            _draw_text(sheet, box, group.label, _LABEL_PT, scene.INK)
    return sum(box is None for box in boxes)


def _draw_evidence(sheet: Sheet, found: ObjectRecord, colour: str) -> None:
    """An estimate's ellipse, and an arrow from where the object stood before it was moved."""
    if found.estimate is not None:
        width, height, angle = scene.two_sigma(found.estimate)
        ellipse = Ellipse(
            found.spot, width, height, angle=angle, fill=False, edgecolor=colour,
            lw=0.7, alpha=0.75 if width < _WIDE_M else 0.35, zorder=8,
            linestyle="-" if found.missing_in is None else (0, (3, 2)),
        )  # fmt: skip
        sheet.axes.add_patch(ellipse)
    if found.relocations:
        last = found.relocations[-1]
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 0.9, "ls": ":"}
        start = last.from_x_um / 1e6, last.from_y_um / 1e6
        sheet.axes.annotate("", found.spot, start, zorder=9, arrowprops=arrow)


def draw_merge_marks(sheet: Sheet, marks: Sequence[scene.MergeMark]) -> None:
    """A ring around each keyframe that merged places, with its text."""
    for mark in marks:
        sheet.axes.scatter(
            [mark.x], [mark.y], s=110, marker="o", facecolor="none", edgecolor=scene.BRIDGE,
            lw=1.8, zorder=13,
        )  # fmt: skip
        sheet.occupied.append(Extent(mark.x, mark.y, 0.12, 0.12))
    requests = [_label_request(sheet, mark.text, (mark.x, mark.y)) for mark in marks]
    boxes = place_labels(requests, sheet.occupied, sheet.bounds, _RINGS_M)
    for mark, box in zip(marks, boxes, strict=True):
        if box is not None:
            _draw_leader(sheet, (mark.x, mark.y), box)
            _draw_text(sheet, box, mark.text, _LABEL_PT, scene.BRIDGE, weight="bold")


def draw_lost(sheet: Sheet, lost: scene.LostRobot) -> None:
    """The lost robot's true position, the estimate with its spread, and a line between them."""
    truth, estimate = lost.truth, lost.estimate
    if estimate is not None:
        if lost.spread_m:
            circle = Circle((estimate.x, estimate.y), lost.spread_m, alpha=0.12, zorder=12)
            circle.set_color(scene.ESTIMATE)
            sheet.axes.add_patch(circle)
        sheet.axes.plot(
            (truth.x, estimate.x), (truth.y, estimate.y), color=scene.ESTIMATE, lw=1.6, ls=":",
            zorder=13,
        )  # fmt: skip
        _draw_robot(sheet, estimate, scene.ESTIMATE, "o")
    _draw_robot(sheet, truth, scene.TRUTH, "X")


def _draw_robot(sheet: Sheet, spot: scene.Spot, colour: str, marker: str) -> None:
    sheet.axes.scatter(
        [spot.x], [spot.y], s=120, marker=marker, facecolor=colour, edgecolor="white", lw=1.2,
        zorder=16,
    )  # fmt: skip
    if spot.yaw_rad is not None:
        tip = spot.x + 0.5 * math.cos(spot.yaw_rad), spot.y + 0.5 * math.sin(spot.yaw_rad)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.8}
        sheet.axes.annotate("", tip, (spot.x, spot.y), zorder=15, arrowprops=arrow)
    sheet.occupied.append(Extent(spot.x, spot.y, 0.15, 0.15))


def _draw_badge(
    sheet: Sheet,
    spot: tuple[float, float],
    text: str,
    size: float,
    colours: tuple[str, str, str],
    shape: str,
) -> None:
    """Text in a box; ``colours`` are the box's fill and edge, and the text's."""
    fill, edge, ink = colours
    box = {"boxstyle": shape, "facecolor": fill, "edgecolor": edge, "lw": 0.9}
    sheet.axes.text(
        *spot, text, ha="center", va="center", size=size, weight="bold", color=ink, bbox=box,
        zorder=14,
    )  # fmt: skip
    lines = text.splitlines()
    half_width = (0.36 * size * max(map(len, lines), default=0) + 0.45 * size) * sheet.unit
    half_height = (0.25 + 0.65 * max(len(lines), 1)) * size * sheet.unit
    sheet.occupied.append(Extent(*spot, half_width, half_height))


def _label_request(sheet: Sheet, text: str, spot: tuple[float, float]) -> LabelRequest:
    width = (0.58 * len(text) * _LABEL_PT + 3) * sheet.unit
    return LabelRequest(*spot, width, 1.3 * _LABEL_PT * sheet.unit)


def _draw_leader(sheet: Sheet, anchor: tuple[float, float], box: Extent) -> None:
    sheet.axes.plot((anchor[0], box.x), (anchor[1], box.y), color=scene.LEADER, lw=0.5, zorder=9)


def _draw_text(
    sheet: Sheet,
    box: Extent,
    text: str,
    size: float,
    colour: str,
    *,
    style: str = "normal",
    weight: str = "normal",
) -> None:
    sheet.occupied.append(box)
    sheet.axes.text(
        box.x, box.y, text, ha="center", va="center", size=size, color=colour, style=style,
        weight=weight, path_effects=HALO, zorder=11,
    )  # fmt: skip


LEGEND = (
    "■ start    ● keyframe, in its place's colour    ◆ object, drawn where the robot saw it from "
    "(mean)    dashed: neighbouring places and their transitions"
)
EVIDENCE_LEGEND = (
    "■ start    ● keyframe, in its place's colour    ◆ object, drawn where it stands, with the "
    "ellipse of two standard errors    ◇ dashed: missing    dotted arrow: moved    "
    "dashed line: neighbouring places"
)


def draw_map(
    view: MapView,
    out: Path,
    *,
    title: str,
    plan: scene.HousePlan | None = None,
    lost: scene.LostRobot | None = None,
    marks: Sequence[scene.MergeMark] = (),
    everything: bool = False,
    min_observations: int = 1,
) -> None:
    """Draw ``view`` to ``out``, in the format of its suffix (.png, .svg, .pdf).

    Objects with fewer than ``min_observations`` are left out, and without ``everything`` those that
    are not confirmed. Raises MisuseError when ``out`` cannot be written or has another suffix.
    """
    check_suffix(out)
    shown = scene.objects_shown(view, everything=everything, min_observations=min_observations)
    compose(view, title, plan or scene.HousePlan(), lost, marks, shown).save(out)


_SMALLER: Final = ((90, 64), (65, 64), (45, 64), (30, 64), (20, 16))
"""Dots per inch and colours of pictures with fewer and fewer bytes."""


@overload
def map_png(view: MapView, title: str) -> bytes: ...
@overload
def map_png(view: MapView, title: str, most_bytes: int) -> bytes | None: ...
def map_png(view: MapView, title: str, most_bytes: int | None = None) -> bytes | None:
    """``view`` drawn as a PNG; with ``most_bytes`` in few colours and as sharp as it can be, None
    if none is so small."""
    sheet = compose(view, title, scene.HousePlan())
    if most_bytes is None:
        return sheet.png()
    pictures = (with_few_colours(sheet.png(dpi), colours) for dpi, colours in _SMALLER)
    return next((picture for picture in pictures if len(picture) <= most_bytes), None)


def compose(
    view: MapView,
    title: str,
    plan: scene.HousePlan,
    lost: scene.LostRobot | None = None,
    marks: Sequence[scene.MergeMark] = (),
    objects: Sequence[ObjectRecord] | None = None,
) -> Sheet:
    """The finished sheet, not yet written to a file; ``objects`` are those to draw, by default the
    confirmed ones."""
    by_evidence = view.settings.fusion == "evidence"
    shown = scene.objects_shown(view) if objects is None else objects
    standing = [found.spot for found in shown] if by_evidence else []
    sheet = new_sheet(view, plan, [*standing, *base_layers.wall_spots(view)])
    base_layers.draw_floor(sheet, plan)
    base_layers.draw_map_walls(sheet, view)
    base_layers.draw_regions(sheet, view)
    base_layers.draw_drives(sheet, view)
    base_layers.draw_walls(sheet, plan)
    draw_adjacency(sheet, view)
    draw_place_names(sheet, view)
    if lost is not None:
        draw_lost(sheet, lost)
    sheet.occupied += (Extent(x, y, DOT_M, DOT_M) for x, y in standing)  # rooms' corners
    draw_room_names(sheet, plan)
    draw_merge_marks(sheet, marks)
    left_out = draw_objects(sheet, shown)
    sheet.header(0, title, 14, scene.INK, "bold")
    sheet.header(1, _numbers(view, len(shown)), 9.5, scene.SMALL_PRINT)
    legend = legend_lines(lost, marks, left_out, by_evidence=by_evidence)
    for line, text in enumerate(legend):
        sheet.footer(line, text, scene.SMALL_PRINT)
    return sheet


def _numbers(view: MapView, shown: int) -> str:
    counts, settings = view.counts(), view.settings
    drawn = "" if shown == counts["confirmed"] else f", {shown:,} shown"
    keyframes = counts["poses" if view.floors else "keyframes"]
    return (
        f"{counted(keyframes, 'keyframe')} ({counts['noise']} in no place)  ·  "
        f"{counted(counts['places'], 'place')}  ·  "
        f"{objects_text(view.objects.values())}{drawn}  ·  {settings.places_text()}"
    )


def legend_lines(
    lost: scene.LostRobot | None,
    marks: Sequence[scene.MergeMark],
    left_out: int,
    *,
    by_evidence: bool = False,
) -> list[str]:
    """The lines below the map; ``left_out`` counts labels without room."""
    parts = []
    if marks:
        parts.append("○ keyframe that made two places one")
    if lost is not None:
        parts.append("✖ lost robot, true spot    ● (red) where the map puts it")
    if left_out:
        parts.append(f"{counted(left_out, 'object label')} had no room")
    return [EVIDENCE_LEGEND if by_evidence else LEGEND, "    ".join(parts)]


def merge_marks(view: MapView, merges: Iterable[Merge | PlacesMerged]) -> list[scene.MergeMark]:
    """One mark for each merge, at the position of its bridging keyframe."""
    names = scene.place_names(view)
    marks: list[scene.MergeMark] = []
    for merge in merges:
        keyframe = view.keyframes[merge.bridge]
        spot = scene.spot_of(keyframe)
        if spot is not None:
            absorbed = " and ".join(names[place] for place in merge.absorbed)
            text = f"{absorbed} into {names[merge.survivor]}, keyframe {keyframe.keyframe_id}"
            marks.append(scene.MergeMark(*spot, text))
    return marks
