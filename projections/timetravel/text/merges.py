"""`mapfold merges` for people."""

from collections.abc import Sequence

from eventsrc.words import counted
from projections.timetravel.history import History
from projections.timetravel.links import reason
from projections.timetravel.lives import EdgeChange, Merge
from projections.timetravel.merge_story import HEADER, merge_row
from projections.timetravel.story import place_name

from .table import shortened, table

MOST = 12


def merges_text(history: History, merges: Sequence[Merge], end: int) -> str:
    """The table of merges, or that there are none."""
    if not merges:
        formed = sum(life.formed.offset < end for life in history.places)
        return f"no merges: {counted(end, 'event')} formed {counted(formed, 'place')}\n"
    rows = [merge_row(history, merge) for merge in merges]
    return table(HEADER, rows, right=("#", "offset", "objects", "edges"))


def merge_text(history: History, merge: Merge) -> str:
    """One merge with everything that made it and that changed hands."""
    cause, after = merge.cause, merge.cause.offset + 1
    lines = [
        f"merge {merge.number} at offset {cause.offset:,} ({cause.when}), shows from --at {after}",
        f"because   {reason(history, merge)}",
        f"survivor  {_place(history, merge.survivor, merge.survivor_size)}",
    ]
    for place, size in zip(merge.absorbed, merge.absorbed_sizes, strict=True):
        lines.append(f"absorbed  {_place(history, place, size)}")
    objects = [history.objects[number] for number in merge.objects]
    named = [f"object    {o.object_id} ({o.found.class_name})" for o in objects]
    lines += shortened(named, MOST, "--json lists all")
    lines += shortened([_edge_text(history, e) for e in merge.edges], MOST, "--json lists all")
    return "".join(f"{line}\n" for line in lines)


def _place(history: History, place: int, size: int) -> str:
    return f"{place_name(history, place)}, {counted(size, 'keyframe')}"


def _edge_text(history: History, edge: EdgeChange) -> str:
    a, b = place_name(history, edge.a), place_name(history, edge.b)
    return f"edge      {a} – {b}: {edge.before:,} → {counted(edge.after, 'shared transition')}"
