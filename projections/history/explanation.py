"""Explain a place by its history, event by event; and why two keyframes are in one place.

Each keyframe joined one place when it was placed; a chain of absorptions leads from there to its
place at any later event. Two are in one place from the event after which both chains lead to the
same place, and the merges on the two chains up to that event are the reason.
"""

from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold.deltas import KeyframeOrdinal, PlaceOrdinal, Pose
from projections.fold.exact import mean_m
from projections.map.records import objects_text
from projections.store.history import NEVER, History
from projections.store.history_records import Cause, Merge, PlaceHistory, count_before

from .merge_reasons import merge_reason
from .names import id_of_place, keyframe_name, place_name, place_title

MOST_FOUNDERS = 6
"""Founding members that are named; one event may place many keyframes."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An event of an explanation: ``what`` is its kind, ``text`` a sentence, ``facts`` for JSON."""

    cause: Cause
    what: str
    text: str
    facts: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        return {**self.cause.document(), "what": self.what, "text": self.text, **self.facts}


@dataclass(frozen=True, slots=True)
class Explanation:
    """The history of ``subject`` in ``entries``, in order, and its state afterwards in ``summary``.

    ``kind`` is ``place``, ``object`` or ``same``.
    """

    kind: str
    subject: str
    summary: str
    entries: tuple[Entry, ...]
    facts: dict[str, Any] = field(default_factory=dict)

    def document(self) -> dict[str, Any]:
        """JSON: the subject, its summary and facts, and every entry."""
        return {
            "kind": self.kind,
            "subject": self.subject,
            "summary": self.summary,
            **self.facts,
            "entries": [entry.document() for entry in self.entries],
        }


def with_entries(found: Explanation, entries: Sequence[Entry]) -> Explanation:
    """The explanation with more entries, each at its offset."""
    both = sorted((*found.entries, *entries), key=lambda entry: entry.cause.offset)
    return replace(found, entries=tuple(both))


def explain_place(history: History, record: PlaceHistory, end: Offset) -> Explanation:
    """Explain a place by the events below ``end``."""
    entries = sorted(
        (e for e in _place_entries(history, record) if e.cause.offset < end),
        key=lambda e: e.cause.offset,
    )
    stands = record.stands(end)
    describe = _standing_place_summary if stands else _other_place_summary
    return Explanation(
        kind="place",
        subject=record.place_id,
        summary=describe(history, record, end),
        entries=tuple(entries),
        facts={
            "stands": stands,
            "absorbed_by": _absorbed_by_document(history, record, end),
            **({} if (name := record.name(end)) is None else {"name": name}),
        },
    )


def _place_entries(history: History, record: PlaceHistory) -> Iterator[Entry]:
    yield _founding(history, record)
    yield from _growth(history, record)
    for merge in record.merges:
        yield _absorbed_others(history, merge)
    if record.absorbed_by is not None:
        yield _absorbed_by(history, record, record.absorbed_by)


def _founding(history: History, record: PlaceHistory) -> Entry:
    founder = record.formed.founder
    founding = count_before(record.joined, Offset(record.formed.offset + 1))
    first = [d.keyframe for d in record.joined[:founding]]
    named = ", ".join(keyframe_name(history, k) for k in first[:MOST_FOUNDERS])
    more = f" and {len(first) - MOST_FOUNDERS} more" if len(first) > MOST_FOUNDERS else ""
    where = position_text(history.keyframes[founder].pose)
    by_rooms = history.settings.places == "rooms"
    how = "was a long drive from every place" if by_rooms else "became the first core point"
    return Entry(
        record.cause,
        "founded",
        f"founded: {keyframe_name(history, founder)} at {where} {how}"
        + (f"; members {named}{more}" if first else ""),
        {
            "founder": keyframe_name(history, founder),
            "members": [keyframe_name(history, k) for k in first],
        },
    )


def _growth(history: History, record: PlaceHistory) -> Iterator[Entry]:
    """An entry each time its size passes 10, 20, 50, 100 … by growth, not by a merge."""
    merged = {merge.cause.offset for merge in record.merges}
    before = 0
    for change in record.changes:
        passed = passed_milestone(before, change.keyframe_count)
        before = change.keyframe_count
        if passed and change.offset not in merged and change.offset != record.formed.offset:
            cause = history.cause_at(change.offset)
            text = f"grew to {counted(change.keyframe_count, 'keyframe')}"
            yield Entry(cause, "grew", text, {"keyframe_count": change.keyframe_count})


def _absorbed_others(history: History, merge: Merge) -> Entry:
    parts = ", ".join(
        f"{place_name(history, place)} ({counted(size, 'keyframe')})"
        for place, size in zip(merge.absorbed, merge.absorbed_sizes, strict=True)
    )
    return Entry(
        merge.cause,
        "absorbed",
        f"absorbed {parts}; it had {merge.survivor_size:,} before; {merge_reason(history, merge)}",
        {"merge": merge.number, "places": [place_name(history, p) for p in merge.absorbed]},
    )


def _absorbed_by(history: History, record: PlaceHistory, merge: Merge) -> Entry:
    size = merge.absorbed_sizes[merge.absorbed.index(record.formed.place)]
    survivor = place_name(history, merge.survivor)
    return Entry(
        merge.cause,
        "ended",
        f"absorbed by {survivor} ({counted(merge.survivor_size, 'keyframe')}); this place had "
        f"{size:,}; {merge_reason(history, merge)}",
        {"merge": merge.number, "survivor": survivor, "keyframe_count": size},
    )


def _other_place_summary(history: History, record: PlaceHistory, end: Offset) -> str:
    merge = record.absorbed_by
    if merge is None or record.formed.offset >= end:
        return f"not founded yet; {record.cause.name} founds it at offset {record.formed.offset:,}"
    now = history.survivor_of(record.formed.place, end)
    then = "" if now == merge.survivor else f"; that is part of {place_name(history, now)} now"
    by = place_name(history, merge.survivor)
    return f"absorbed by {by} at offset {merge.cause.offset:,} ({merge.cause.when}){then}"


def _absorbed_by_document(
    history: History, record: PlaceHistory, end: Offset
) -> dict[str, object] | None:
    merge = record.absorbed_by
    if merge is None or merge.cause.offset >= end:
        return None
    return {"place_id": place_name(history, merge.survivor), **merge.cause.document()}


def _standing_place_summary(history: History, record: PlaceHistory, end: Offset) -> str:
    parts = [
        _objects_text(history, record.formed.place, end),
        _neighbours_text(history, record.formed.place, end),
    ]
    if (name := record.name(end)) is not None:
        parts.insert(0, f'called "{name}"')
    if (change := record.change(end)) is not None:
        x, y = (mean_m(s, change.keyframe_count) for s in (change.sum_x_um, change.sum_y_um))
        size = f"{counted(change.keyframe_count, 'keyframe')} around ({x:.2f}, {y:.2f})"
        parts.insert(0 if name is None else 1, size)
    return "; ".join(parts)


def _objects_text(history: History, place: PlaceOrdinal, end: Offset) -> str:
    inside = [
        each
        for each, record in zip(history.objects_at(end), history.objects, strict=False)
        if each.place == place and record.stands(end)
    ]
    if not inside:
        return "no objects"
    classes = Counter(each.class_name for each in inside if each.confirmed)
    if not classes:
        return objects_text(inside)
    most = sorted(classes.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(name if count == 1 else f"{name} ×{count}" for name, count in most[:8])
    others = len(most) - 8
    more = f" and {others} more {'class' if others == 1 else 'classes'}" if others > 0 else ""
    return f"{objects_text(inside)}: {named}{more}"


def _neighbours_text(history: History, place: PlaceOrdinal, end: Offset) -> str:
    found = [
        (count, b if a == place else a)
        for a, b in history.edges
        if place in (a, b) and (count := history.transitions(a, b, end))
    ]
    if not found:
        return "next to no other place"
    found.sort(key=lambda item: (-item[0], item[1]))
    return "next to " + ", ".join(f"{place_title(history, p, end)} ({n}×)" for n, p in found)


def explain_same_place(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal, end: Offset
) -> Explanation:
    """Why keyframes ``first`` and ``second`` are in one place, or not, after ``end`` events."""
    since = together_since(history, first, second)
    together = since is not None and since < end
    until = Offset(since + 1) if since is not None and together else end
    entries = [
        _placed_entry(history, k)
        for k in dict.fromkeys((first, second))
        if history.placed_offsets[k] < end
    ]
    entries += [
        _merged_entry(history, merge) for merge in _merges_of(history, (first, second), until)
    ]
    return Explanation(
        kind="same",
        subject=f"{keyframe_name(history, first)} and {keyframe_name(history, second)}",
        summary=_same_place_summary(history, first, second, since if together else None, end),
        entries=tuple(sorted(entries, key=lambda entry: entry.cause.offset)),
        facts={
            "same": together,
            "since": since if together else None,
            "places": [id_of_place(history, history.place_at(k, end)) for k in (first, second)],
        },
    )


def together_since(
    history: History, first: KeyframeOrdinal, second: KeyframeOrdinal
) -> Offset | None:
    """The offset of the event that first brought two keyframes into one place; None for never."""
    joined = Offset(max(history.placed_offsets[first], history.placed_offsets[second]))
    if joined == NEVER:
        return None
    chain = _merges_of(history, (first, second), NEVER)
    for offset in sorted({joined, *(m.cause.offset for m in chain if m.cause.offset > joined)}):
        after = Offset(offset + 1)
        if history.place_at(first, after) == history.place_at(second, after):
            return offset
    return None


def _merges_of(
    history: History, keyframes: tuple[KeyframeOrdinal, KeyframeOrdinal], end: Offset
) -> list[Merge]:
    """Merges below ``end`` that moved either keyframe from one place to another, in order."""
    merges: dict[int, Merge] = {}
    for keyframe in keyframes:
        if history.placed_offsets[keyframe] >= end:
            continue
        place = history.placed_in[keyframe]
        while (merge := history.places[place].absorbed_by) is not None and merge.cause.offset < end:
            merges[merge.number] = merge
            place = merge.survivor
    return [merges[number] for number in sorted(merges)]


def _placed_entry(history: History, keyframe: KeyframeOrdinal) -> Entry:
    place = place_name(history, history.placed_in[keyframe])
    offset = Offset(history.placed_offsets[keyframe])
    own = history.keyframe_offsets[keyframe]
    wait = counted(offset - own, "event")
    late = "" if offset == own else f", {wait} after it came: it was noise before"
    name = keyframe_name(history, keyframe)
    return Entry(
        history.cause_at(offset),
        "placed",
        f"{name} at {position_text(history.keyframes[keyframe].pose)} joined {place}{late}",
        {"keyframe": name, "place_id": place},
    )


def _merged_entry(history: History, merge: Merge) -> Entry:
    survivor = place_name(history, merge.survivor)
    absorbed = ", ".join(place_name(history, place) for place in merge.absorbed)
    return Entry(
        merge.cause,
        "merged",
        f"{survivor} absorbed {absorbed}; {merge_reason(history, merge)}",
        {"merge": merge.number},
    )


def _same_place_summary(
    history: History,
    first: KeyframeOrdinal,
    second: KeyframeOrdinal,
    since: Offset | None,
    end: Offset,
) -> str:
    if since is not None:
        cause = history.cause_at(since)
        now = place_title(history, history.place_at(first, end), end)
        return f"in one place since offset {since:,} ({cause.title}); it is {now} now"
    return "not in one place: " + "; ".join(
        _place_of_keyframe(history, k, end) for k in (first, second)
    )


def _place_of_keyframe(history: History, keyframe: KeyframeOrdinal, end: Offset) -> str:
    name = keyframe_name(history, keyframe)
    if history.keyframe_offsets[keyframe] >= end:
        return f"{name} has not come yet"
    if history.keyframes[keyframe].pose is None:
        return f"{name} has no pose"
    place = history.place_at(keyframe, end)
    where = "noise" if place is None else f"in {place_title(history, place, end)}"
    return f"{name} is {where}"


def position_text(pose: Pose | None) -> str:
    """``(x, y)`` of a pose in metres, or ``no pose``."""
    return "no pose" if pose is None else f"({pose.x_um / 1e6:.2f}, {pose.y_um / 1e6:.2f})"


def passed_milestone(before: int, after: int) -> bool:
    """Whether a count passed one of 10, 20, 50, 100, 200, 500 …: growth that gets an entry."""
    return _milestones_up_to(after) > _milestones_up_to(before)


def _milestones_up_to(count: int) -> int:
    if count < 10:
        return 0
    digits = str(count)
    return 3 * (len(digits) - 2) + bisect_right("125", digits[0])
