"""The upper layers of a picture: adjacency, names, objects, merges, the lost robot.

Each text adds its box to the canvas' occupied ones, so that later and less important labels keep
clear of it.
"""

import math
from collections.abc import Sequence

from matplotlib.patches import Circle, Ellipse

from projections.adapters import palette
from projections.adapters.scene import (
    Floor,
    LostRobot,
    MergeMark,
    Spot,
    object_groups,
    place_badges,
    two_sigma,
)
from projections.map.records import ObjectRecord
from projections.map.view import MapView

from .canvas import HALO, Extent, LabelRequest, Sheet, place_labels

DOT_M = 0.04
"""Half the size of the box that an object's dot occupies."""
_LABEL_PT = 8.0
_WIDE_M = 2.0
"""Ellipses wider than this are drawn faintly."""
_RINGS_M = tuple(0.07 * 1.28**step for step in range(15))


def draw_adjacency(canvas: Sheet, view: MapView) -> None:
    """A dashed line between neighbouring places and the number of transitions on it; a dotted one
    between two floors."""
    for a, b, count in view.edges():
        one, other = view.places[a], view.places[b]
        start, end = (one.centroid_x, one.centroid_y), (other.centroid_x, other.centroid_y)
        dashes = (1, 2) if view.is_between_floors(a, b) else (4, 3)
        line = {"arrowstyle": "-", "color": palette.INK, "lw": 1.2, "ls": (0, dashes)}
        canvas.axes.annotate("", end, start, zorder=8, arrowprops=line)
        middle = (start[0] + end[0]) / 2, (start[1] + end[1]) / 2
        _draw_badge(
            canvas, middle, str(count), 7.5, ("white", palette.INK, palette.INK), "round,pad=0.2"
        )


def draw_place_names(canvas: Sheet, view: MapView) -> None:
    """Each place's name on its centroid, in its colour, with its likely type."""
    names = place_badges(view)
    for ordinal, place in view.places.items():
        centroid = place.centroid_x, place.centroid_y
        colours = palette.place_colour(ordinal), "white", "white"
        _draw_badge(
            canvas, centroid, names[ordinal], 10, colours, "round,pad=0.3,rounding_size=0.9"
        )


def draw_room_names(canvas: Sheet, floor: Floor) -> None:
    """Each room's name, in the first of its corners that is free."""
    height = 12 * canvas.unit
    for name, (x0, y0, x1, y1) in floor.rooms:
        width = 5.6 * len(name) * canvas.unit
        dx, dy = width / 2 + 0.14, height / 2 + 0.1
        corners = ((x0 + dx, y1 - dy), (x1 - dx, y1 - dy), (x0 + dx, y0 + dy), (x1 - dx, y0 + dy))
        boxes = [Extent(x, y, width / 2, height / 2) for x, y in corners]
        free = [box for box in boxes if not any(box.overlaps(other) for other in canvas.occupied)]
        _draw_text(canvas, (free or boxes)[0], name, 9.5, palette.ROOM_NAME, style="italic")


def draw_objects(canvas: Sheet, view: MapView, min_observations: int) -> int:
    """A dot for each object, a label for each group; returns how many labels did not fit."""
    groups = object_groups(view, min_observations)
    for group in groups:
        colour = palette.INK if group.place is None else palette.place_colour(group.place)
        xs, ys = zip(*(member.spot for member in group.members), strict=True)
        face, edge = ("white", colour) if group.missing else (colour, "white")
        width = 1.1 if group.missing else 0.6
        canvas.axes.scatter(
            xs, ys, s=15, marker="D", facecolor=face, edgecolor=edge, lw=width, zorder=10
        )
        for member in group.members:
            _draw_evidence(canvas, member, colour)
        canvas.occupied += (Extent(x, y, DOT_M, DOT_M) for x, y in zip(xs, ys, strict=True))
    requests = [_label_request(canvas, group.label, group.spot) for group in groups]
    boxes = place_labels(requests, canvas.occupied, canvas.bounds, _RINGS_M)
    for group, box in zip(groups, boxes, strict=True):
        if box is not None:
            _draw_leader(canvas, group.spot, box)
            _draw_text(canvas, box, group.label, _LABEL_PT, palette.INK)
    return sum(box is None for box in boxes)


def _draw_evidence(canvas: Sheet, found: ObjectRecord, colour: str) -> None:
    """An estimate's ellipse, and an arrow from where the object stood before it was moved."""
    if found.estimate is not None:
        width, height, angle = two_sigma(found.estimate)
        ellipse = Ellipse(
            found.spot, width, height, angle=angle, fill=False, edgecolor=colour,
            lw=0.7, alpha=0.75 if width < _WIDE_M else 0.35, zorder=8,
            linestyle="-" if found.missing_in is None else (0, (3, 2)),
        )  # fmt: skip
        canvas.axes.add_patch(ellipse)
    if found.relocations:
        last = found.relocations[-1]
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 0.9, "ls": ":"}
        start = last.from_x_um / 1e6, last.from_y_um / 1e6
        canvas.axes.annotate("", found.spot, start, zorder=9, arrowprops=arrow)


def draw_bridges(canvas: Sheet, bridges: Sequence[MergeMark]) -> None:
    """A ring around each keyframe that merged places, with its text."""
    for bridge in bridges:
        canvas.axes.scatter(
            [bridge.x], [bridge.y], s=110, marker="o", facecolor="none", edgecolor=palette.BRIDGE,
            lw=1.8, zorder=13,
        )  # fmt: skip
        canvas.occupied.append(Extent(bridge.x, bridge.y, 0.12, 0.12))
    requests = [_label_request(canvas, bridge.text, (bridge.x, bridge.y)) for bridge in bridges]
    boxes = place_labels(requests, canvas.occupied, canvas.bounds, _RINGS_M)
    for bridge, box in zip(bridges, boxes, strict=True):
        if box is not None:
            _draw_leader(canvas, (bridge.x, bridge.y), box)
            _draw_text(canvas, box, bridge.text, _LABEL_PT, palette.BRIDGE, weight="bold")


def draw_lost(canvas: Sheet, lost: LostRobot) -> None:
    """The lost robot's true position, the estimate with its spread, and a line between them."""
    truth, estimate = lost.truth, lost.estimate
    if estimate is not None:
        if lost.spread_m:
            circle = Circle((estimate.x, estimate.y), lost.spread_m, alpha=0.12, zorder=12)
            circle.set_color(palette.ESTIMATE)
            canvas.axes.add_patch(circle)
        canvas.axes.plot(
            (truth.x, estimate.x), (truth.y, estimate.y), color=palette.ESTIMATE, lw=1.6, ls=":",
            zorder=13,
        )  # fmt: skip
        _draw_robot(canvas, estimate, palette.ESTIMATE, "o")
    _draw_robot(canvas, truth, palette.TRUTH, "X")


def _draw_robot(canvas: Sheet, spot: Spot, colour: str, marker: str) -> None:
    canvas.axes.scatter(
        [spot.x], [spot.y], s=120, marker=marker, facecolor=colour, edgecolor="white", lw=1.2,
        zorder=16,
    )  # fmt: skip
    if spot.yaw_rad is not None:
        tip = spot.x + 0.5 * math.cos(spot.yaw_rad), spot.y + 0.5 * math.sin(spot.yaw_rad)
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.8}
        canvas.axes.annotate("", tip, (spot.x, spot.y), zorder=15, arrowprops=arrow)
    canvas.occupied.append(Extent(spot.x, spot.y, 0.15, 0.15))


def _draw_badge(
    canvas: Sheet,
    spot: tuple[float, float],
    text: str,
    size: float,
    colours: tuple[str, str, str],
    shape: str,
) -> None:
    """Text in a box; ``colours`` are the box's fill and edge, and the text's."""
    fill, edge, ink = colours
    box = {"boxstyle": shape, "facecolor": fill, "edgecolor": edge, "lw": 0.9}
    canvas.axes.text(
        *spot, text, ha="center", va="center", size=size, weight="bold", color=ink, bbox=box,
        zorder=14,
    )  # fmt: skip
    lines = text.splitlines()
    half_width = (0.36 * size * max(map(len, lines), default=0) + 0.45 * size) * canvas.unit
    half_height = (0.25 + 0.65 * max(len(lines), 1)) * size * canvas.unit
    canvas.occupied.append(Extent(*spot, half_width, half_height))


def _label_request(canvas: Sheet, text: str, spot: tuple[float, float]) -> LabelRequest:
    width = (0.58 * len(text) * _LABEL_PT + 3) * canvas.unit
    return LabelRequest(*spot, width, 1.3 * _LABEL_PT * canvas.unit)


def _draw_leader(canvas: Sheet, anchor: tuple[float, float], box: Extent) -> None:
    canvas.axes.plot((anchor[0], box.x), (anchor[1], box.y), color=palette.LEADER, lw=0.5, zorder=9)


def _draw_text(
    canvas: Sheet,
    box: Extent,
    text: str,
    size: float,
    colour: str,
    *,
    style: str = "normal",
    weight: str = "normal",
) -> None:
    canvas.occupied.append(box)
    canvas.axes.text(
        box.x, box.y, text, ha="center", va="center", size=size, color=colour, style=style,
        weight=weight, path_effects=HALO, zorder=11,
    )  # fmt: skip
