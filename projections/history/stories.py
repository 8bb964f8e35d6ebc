"""Why a place is what it is: founded, grown, merged, perhaps absorbed.

Why an object is what it is: found by which detection, seen how often, located where and when.
"""

from collections import Counter
from collections.abc import Iterator, Sequence

from eventsrc.envelope import Offset
from eventsrc.text import counted
from projections.deltas import PlaceOrdinal
from projections.exact import Q40, mean_m

from .history import History
from .merges import reason
from .records import Merge, ObjectLife, PlaceLife, count_before, last_before
from .story import Entry, Story, keyframe_name, passed_mark, place_name, spot

MOST_FOUNDERS = 6
"""Founding members named; a place is founded by few, but one event may pull in many."""


def place_story(history: History, life: PlaceLife, end: Offset) -> Story:
    """The chronicle of a place through the events below ``end``."""
    entries = sorted(
        (e for e in _place_entries(history, life) if e.cause.offset < end),
        key=lambda e: e.cause.offset,
    )
    stands = life.stands(end)
    return Story(
        kind="place",
        subject=life.place_id,
        summary=_standing(history, life, end) if stands else _ended(history, life, end),
        entries=tuple(entries),
        facts={"stands": stands, "absorbed_by": _absorber(history, life, end)},
    )


def _place_entries(history: History, life: PlaceLife) -> Iterator[Entry]:
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


def _ended(history: History, life: PlaceLife, end: Offset) -> str:
    merge = life.absorbed
    if merge is None or life.formed.offset >= end:
        return f"not founded yet; {life.cause.name} founds it at offset {life.formed.offset:,}"
    now = history.survivor_of(life.formed.place, end)
    then = "" if now == merge.survivor else f"; that is part of {place_name(history, now)} now"
    by = place_name(history, merge.survivor)
    return f"absorbed by {by} at offset {merge.cause.offset:,} ({merge.cause.when}){then}"


def _absorber(history: History, life: PlaceLife, end: Offset) -> dict[str, object] | None:
    merge = life.absorbed
    if merge is None or merge.cause.offset >= end:
        return None
    return {"place_id": place_name(history, merge.survivor), **merge.cause.document()}


def _standing(history: History, life: PlaceLife, end: Offset) -> str:
    parts = [
        _objects(history, life.formed.place, end),
        _neighbours(history, life.formed.place, end),
    ]
    if (change := life.change(end)) is not None:
        x, y = (mean_m(s, change.keyframe_count) for s in (change.sum_x_um, change.sum_y_um))
        parts.insert(0, f"{counted(change.keyframe_count, 'keyframe')} around ({x:.2f}, {y:.2f})")
    return "; ".join(parts)


def _objects(history: History, place: PlaceOrdinal, end: Offset) -> str:
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


def _neighbours(history: History, place: PlaceOrdinal, end: Offset) -> str:
    found = [
        (count, b if a == place else a)
        for a, b in history.edges
        if place in (a, b) and (count := history.transitions(a, b, end))
    ]
    if not found:
        return "next to no other place"
    found.sort(key=lambda item: (-item[0], item[1]))
    return "next to " + ", ".join(f"{place_name(history, p)} ({n}×)" for n, p in found)


def object_story(history: History, det_ids: Sequence[str], life: ObjectLife, end: Offset) -> Story:
    """The chronicle of an object through the events below ``end``.

    ``det_ids`` are those of its sightings, parallel to ``life.seen``.
    """
    entries = sorted(
        (e for e in _object_entries(history, det_ids, life) if e.cause.offset < end),
        key=lambda entry: entry.cause.offset,
    )
    seen = count_before(life.seen, end)
    return Story(
        kind="object",
        subject=life.object_id,
        summary=_summary(history, life, end),
        entries=tuple(entries),
        facts={
            "class_name": life.found.class_name,
            "place_id": _place_id(history, life.place(end)),
            "det_ids": det_ids[:seen],
        },
    )


def _place_id(history: History, place: PlaceOrdinal | None) -> str | None:
    return None if place is None else place_name(history, place)


def _summary(history: History, life: ObjectLife, end: Offset) -> str:
    last = last_before(life.seen, end)
    if last is None:
        return "not seen yet"
    x, y = mean_m(last.sum_x_um, last.obs_count), mean_m(last.sum_y_um, last.obs_count)
    least = min(s.similarity_q40 for s in life.seen[: count_before(life.seen, end)]) / Q40
    similar = f", each at least {least:.2f} like it" if last.obs_count > 1 else ""
    return (
        f"a {life.found.class_name} seen {counted(last.obs_count, 'time')}{similar}, "
        f"on average from ({x:.2f}, {y:.2f}); in {place_name(history, life.place(end))}"
    )


def _object_entries(history: History, det_ids: Sequence[str], life: ObjectLife) -> Iterator[Entry]:
    pose = history.keyframes[history.keyframe_count(Offset(life.found.offset + 1)) - 1].pose
    yield Entry(
        life.cause,
        "found",
        f"found: {det_ids[0]}, seen from {spot(pose)}, was like no {life.found.class_name} near it",
        {"det_id": det_ids[0]},
    )
    yield from _sightings(history, life)
    yield from _moves(history, life)


def _sightings(history: History, life: ObjectLife) -> Iterator[Entry]:
    before = 1
    for seen in life.seen:
        if passed_mark(before, seen.obs_count):
            text = f"seen {counted(seen.obs_count, 'time')}"
            yield Entry(history.cause_at(seen.offset), "seen", text, {"obs_count": seen.obs_count})
        before = seen.obs_count


def _moves(history: History, life: ObjectLife) -> Iterator[Entry]:
    before: PlaceOrdinal | None = None
    for moved in life.located:
        cause = history.cause_at(moved.offset)
        facts = {"from": _place_id(history, before), "to": _place_id(history, moved.place)}
        yield Entry(cause, "located", _move_text(history, before, moved.place, moved.offset), facts)
        before = moved.place


def _move_text(
    history: History, before: PlaceOrdinal | None, after: PlaceOrdinal | None, offset: Offset
) -> str:
    to = place_name(history, after)
    if before is None:
        return f"located in {to}"
    merge = history.places[before].absorbed
    if merge is not None and merge.cause.offset == offset:
        return f"located in {to}, which absorbed {place_name(history, before)}"
    return f"located in {to} instead of {place_name(history, before)}: most sightings are there"
