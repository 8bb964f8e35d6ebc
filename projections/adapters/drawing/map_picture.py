"""A map's picture: layers from the floor up, fixed text before labels that can be moved.

Objects are drawn at their estimated position under fusion by evidence; else at the mean position of
the *robot* when it saw them. Their labels are moved to stay legible, and a thin line leads back.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, overload

from eventsrc.base.text import counted
from eventsrc.envelope.grey_images import with_few_colours
from projections.adapters import palette, scene
from projections.fold.deltas import PlacesMerged
from projections.map.confirmed import objects_text
from projections.map.records import ObjectRecord
from projections.map.view import MapView
from projections.store.history_records import Merge

from . import base_layers, overlays
from .sheet import Extent, Sheet, check_suffix, new_sheet

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
    overlays.draw_adjacency(sheet, view)
    overlays.draw_place_names(sheet, view)
    if lost is not None:
        overlays.draw_lost(sheet, lost)
    sheet.occupied += (
        Extent(x, y, overlays.DOT_M, overlays.DOT_M) for x, y in standing
    )  # rooms' corners
    overlays.draw_room_names(sheet, plan)
    overlays.draw_merge_marks(sheet, marks)
    left_out = overlays.draw_objects(sheet, shown)
    sheet.header(0, title, 14, palette.INK, "bold")
    sheet.header(1, _numbers(view, len(shown)), 9.5, palette.SMALL_PRINT)
    legend = legend_lines(lost, marks, left_out, by_evidence=by_evidence)
    for line, text in enumerate(legend):
        sheet.footer(line, text, palette.SMALL_PRINT)
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
