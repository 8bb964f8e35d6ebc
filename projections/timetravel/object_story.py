"""Why an object is what it is: found by which detection, seen how often, located where and when."""

from collections.abc import Iterator

from eventsrc.words import counted
from projections.exact import Q40, mean_m

from .history import History
from .lives import ObjectLife, count_before, last_before
from .story import Entry, Story, passed_mark, place_name, spot


def object_story(history: History, det_ids: list[str], life: ObjectLife, end: int) -> Story:
    """The chronicle of an object through the events below ``end``.

    ``det_ids`` are those of its sightings, parallel to ``life.seen``.
    """
    entries = sorted(
        (e for e in _entries(history, det_ids, life) if e.cause.offset < end),
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


def _place_id(history: History, place: int | None) -> str | None:
    return None if place is None else place_name(history, place)


def _summary(history: History, life: ObjectLife, end: int) -> str:
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


def _entries(history: History, det_ids: list[str], life: ObjectLife) -> Iterator[Entry]:
    pose = history.keyframes[history.keyframe_count(life.found.offset + 1) - 1].pose
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
    before: int | None = None
    for moved in life.located:
        cause = history.cause_at(moved.offset)
        facts = {"from": _place_id(history, before), "to": _place_id(history, moved.place)}
        yield Entry(cause, "located", _move_text(history, before, moved.place, moved.offset), facts)
        before = moved.place


def _move_text(history: History, before: int | None, after: int | None, offset: int) -> str:
    to = place_name(history, after)
    if before is None:
        return f"located in {to}"
    merge = history.places[before].absorbed
    if merge is not None and merge.cause.offset == offset:
        return f"located in {to}, which absorbed {place_name(history, before)}"
    return f"located in {to} instead of {place_name(history, before)}: most sightings are there"
