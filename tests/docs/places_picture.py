"""docs/images/place-merge.svg: a merge, drawn from what the reducer itself knows before and after.

python -m tests.docs.places_picture        draws it again
"""

from pathlib import Path

from projections.fold.core_index import CoreIndex, cell_side_um
from projections.fold.deltas import PlacesMerged
from projections.fold.place_members import PosedKeyframe
from projections.fold.places import Places

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "place-merge.svg"
EPS_UM, LEAST = 1_500_000, 3
LEFT = [
    (-2.6, 0.5),
    (-2.9, 0.2),
    (-2.4, 0.9),
    (-2.9, 1.2),
    (-2.2, 1.1),
    (-1.8, 0.4),
    (-2.5, -0.3),
    (-2.0, 1.6),
    (-1.2, 0.8),
]
RIGHT = [(1.6, 0.2), (2.1, 0.8), (2.4, -0.1), (2.8, 0.5), (3.0, 1.2), (1.9, 1.5)]
LONE = [(0.4, -1.0), (-3.2, -1.7), (4.35, 0.9)]
BRIDGE = (0.2, 0.4)
"""Metres, in order of arrival: two rooms, three stragglers, and the keyframe in the doorway."""

PX_PER_M = 46
LOW, HIGH = (-3.9, -2.4), (5.0, 2.3)
COLOURS = {None: "#888888", 0: "#1f6fb2", 1: "#d1662b"}


def drawn() -> str:
    """The SVG."""
    places = Places(CoreIndex(EPS_UM, LEAST))
    for x, y in [*LEFT, *RIGHT, *LONE]:
        _fold(places, x, y)
    before = _panel(places, f"before: {_legend(places)}", None)
    merge = next(d for d in _fold(places, *BRIDGE) if isinstance(d, PlacesMerged))
    after = _panel(places, f"after: {_legend(places)}", merge)
    width = (HIGH[0] - LOW[0]) * PX_PER_M
    height = (HIGH[1] - LOW[1]) * PX_PER_M + 26
    style = f'height="{2 * height + 14:.0f}" font-family="sans-serif" font-size="13"'
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" {style}>',
            '<rect width="100%" height="100%" fill="white"/>',
            "<g>",
            *before,
            "</g>",
            f'<g transform="translate(0 {height + 14:.0f})">',
            *after,
            "</g>",
            "</svg>\n",
        ]
    )


def _fold(places: Places, x: float, y: float) -> list[object]:
    n = len(places.joined)
    return list(places.fold(PosedKeyframe(n, n, 0, "run", round(x * 1e6), round(y * 1e6))))


def _legend(places: Places) -> str:
    labels = [places.label(n) for n in range(len(places.joined))]
    parts = [f"p{p} with {labels.count(p)} keyframes" for p in sorted({*labels} - {None})]
    return ", ".join([*parts, f"{labels.count(None)} noise"])


def _panel(places: Places, title: str, merge: PlacesMerged | None) -> list[str]:
    lines = [f'<text x="8" y="17">{title}</text>', *_grid(places)]
    cores = [n for n in range(len(places.joined)) if places.core_index.is_core(n)]
    lines += [_circle(places, n, EPS_UM, COLOURS[places.label(n)], 0.05) for n in cores]
    if merge is not None:
        lines.append(_circle(places, merge.bridge, EPS_UM, "#000000", 0.0, dashed=True))
        for link in merge.links:
            (x1, y1), (x2, y2) = _at(places, link.core), _at(places, link.neighbour)
            lines.append(
                f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" '
                'stroke="black" stroke-width="2"/>'
            )
    return lines + [_point(places, n) for n in range(len(places.joined))]


def _grid(places: Places) -> list[str]:
    """The cells that hold points; dense ones shaded."""
    side_um, index = cell_side_um(EPS_UM), places.core_index
    cells: dict[tuple[int, int], int] = {}
    for x_um, y_um in zip(index.x, index.y, strict=True):
        key = x_um // side_um, y_um // side_um
        cells[key] = cells.get(key, 0) + 1
    lines = []
    for (column, row), count in cells.items():
        x, y = _pixels(column * side_um, (row + 1) * side_um)
        fill = "#e4ecd8" if count >= LEAST else "none"
        size = side_um / 1e6 * PX_PER_M
        lines.append(
            f'<rect x="{x:.1f}" y="{y:.1f}" width="{size:.1f}" height="{size:.1f}" '
            f'fill="{fill}" stroke="#c8c8c8"/>'
        )
    return lines


def _point(places: Places, n: int) -> str:
    """Core points are filled, border points hollow, noise is a small ring."""
    x, y = _at(places, n)
    colour = COLOURS[places.label(n)]
    fill = colour if places.core_index.is_core(n) else "white"
    radius = 3.0 if places.label(n) is None else 4.5
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{fill}" '
        f'stroke="{colour}" stroke-width="1.6"/>'
    )


def _circle(
    places: Places, n: int, radius_um: int, colour: str, opacity: float, *, dashed: bool = False
) -> str:
    x, y = _at(places, n)
    edge = f'stroke="{colour}" stroke-dasharray="4 4"' if dashed else ""
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius_um / 1e6 * PX_PER_M:.1f}" '
        f'fill="{colour}" fill-opacity="{opacity}" {edge}/>'
    )


def _at(places: Places, n: int) -> tuple[float, float]:
    return _pixels(places.core_index.x[n], places.core_index.y[n])


def _pixels(x_um: int, y_um: int) -> tuple[float, float]:
    return (x_um / 1e6 - LOW[0]) * PX_PER_M, (HIGH[1] - y_um / 1e6) * PX_PER_M + 26


if __name__ == "__main__":
    PICTURE.write_text(drawn(), "utf-8")
