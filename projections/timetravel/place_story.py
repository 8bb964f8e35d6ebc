"""Why a place is what it is: founded, grown, merged, perhaps absorbed."""

from collections import Counter
from collections.abc import Iterator

from eventsrc.words import counted
from projections.exact import mean_m

from .history import History
from .links import reason
from .lives import Merge, PlaceLife
from .story import Entry, Story, keyframe_name, passed_mark, place_name, spot

MOST_FOUNDERS = 6
"""Founding members named; a place is founded by few, but one event may pull in many."""


def place_story(history: History, life: PlaceLife, end: int) -> Story:
    """The chronicle of a place through the events below ``end``."""
    entries = sorted(
        (e for e in _entries(history, life) if e.cause.offset < end), key=lambda e: e.cause.offset
    )
    stands = life.stands(end)
    return Story(
        kind="place",
        subject=life.place_id,
        summary=_standing(history, life, end) if stands else _ended(history, life, end),
        entries=tuple(entries),
        facts={"stands": stands, "absorbed_by": _absorber(history, life, end)},
    )


def _entries(history: History, life: PlaceLife) -> Iterator[Entry]:
    yield _founded(history, life)
    yield from _grown(history, life)
    for merge in life.merges:
        yield _absorbing(history, merge)
    if life.absorbed is not None:
        yield _absorption(history, life, life.absorbed)


def _founded(history: History, life: PlaceLife) -> Entry:
    founder = life.formed.founder
    first = [d.keyframe for d in life.joined if d.offset == life.formed.offset]
    named = ", ".join(keyframe_name(history, k) for k in first[:MOST_FOUNDERS])
    more = f" and {len(first) - MOST_FOUNDERS} more" if len(first) > MOST_FOUNDERS else ""
    where = spot(history.keyframes[founder].pose)
    return Entry(
        life.cause,
        "founded",
        f"founded: {keyframe_name(history, founder)} at {where} became the first core point; "
        f"members {named}{more}",
        {
            "founder": keyframe_name(history, founder),
            "members": [keyframe_name(history, k) for k in first],
        },
    )


def _grown(history: History, life: PlaceLife) -> Iterator[Entry]:
    """One entry each time its size passes 10, 20, 50, 100 … by growing, not by merging."""
    merged = {merge.cause.offset for merge in life.merges}
    before = 0
    for change in life.changes:
        mark = passed_mark(before, change.keyframe_count)
        before = change.keyframe_count
        if mark and change.offset not in merged and change.offset != life.formed.offset:
            cause = history.cause_at(change.offset)
            text = f"grew to {counted(change.keyframe_count, 'keyframe')}"
            yield Entry(cause, "grew", text, {"keyframe_count": change.keyframe_count})


def _absorbing(history: History, merge: Merge) -> Entry:
    parts = ", ".join(
        f"{place_name(history, place)} ({counted(size, 'keyframe')})"
        for place, size in zip(merge.absorbed, merge.absorbed_sizes, strict=True)
    )
    return Entry(
        merge.cause,
        "absorbed",
        f"absorbed {parts}, having {merge.survivor_size:,} itself; {reason(history, merge)}",
        {"merge": merge.number, "places": [place_name(history, p) for p in merge.absorbed]},
    )


def _absorption(history: History, life: PlaceLife, merge: Merge) -> Entry:
    size = merge.absorbed_sizes[merge.absorbed.index(life.formed.place)]
    survivor = place_name(history, merge.survivor)
    return Entry(
        merge.cause,
        "ended",
        f"absorbed by {survivor} ({counted(merge.survivor_size, 'keyframe')}), having {size:,} "
        f"itself; {reason(history, merge)}",
        {"merge": merge.number, "survivor": survivor, "keyframe_count": size},
    )


def _ended(history: History, life: PlaceLife, end: int) -> str:
    merge = life.absorbed
    if merge is None or life.formed.offset >= end:
        return f"not founded yet; {life.cause.name} founds it at offset {life.formed.offset:,}"
    now = history.survivor_of(life.formed.place, end)
    then = "" if now == merge.survivor else f"; that is part of {place_name(history, now)} now"
    by = place_name(history, merge.survivor)
    return f"absorbed by {by} at offset {merge.cause.offset:,} ({merge.cause.when}){then}"


def _absorber(history: History, life: PlaceLife, end: int) -> dict[str, object] | None:
    merge = life.absorbed
    if merge is None or merge.cause.offset >= end:
        return None
    return {"place_id": place_name(history, merge.survivor), **merge.cause.document()}


def _standing(history: History, life: PlaceLife, end: int) -> str:
    parts = [
        _objects(history, life.formed.place, end),
        _neighbours(history, life.formed.place, end),
    ]
    if (change := life.change(end)) is not None:
        x, y = (mean_m(s, change.keyframe_count) for s in (change.sum_x_um, change.sum_y_um))
        parts.insert(0, f"{counted(change.keyframe_count, 'keyframe')} around ({x:.2f}, {y:.2f})")
    return "; ".join(parts)


def _objects(history: History, place: int, end: int) -> str:
    classes = Counter(
        o.found.class_name
        for o in history.objects
        if o.found.offset < end and o.place(end) == place
    )
    if not classes:
        return "no objects"
    most = sorted(classes.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(name if count == 1 else f"{name} ×{count}" for name, count in most[:8])
    others = len(most) - 8
    more = f" and {others} more {'class' if others == 1 else 'classes'}" if others > 0 else ""
    return f"{counted(classes.total(), 'object')}: {named}{more}"


def _neighbours(history: History, place: int, end: int) -> str:
    found = [
        (count, b if a == place else a)
        for a, b in history.edges
        if place in (a, b) and (count := history.transitions(a, b, end))
    ]
    if not found:
        return "next to no other place"
    found.sort(key=lambda item: (-item[0], item[1]))
    return "next to " + ", ".join(f"{place_name(history, p)} ({n}×)" for n, p in found)
