"""Explain a place or an object: its history, event by event."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold.deltas import ObjectSeen, ObservationOrdinal, PlaceOrdinal, Pose
from projections.fold.exact import Q40, mean_m
from projections.map.records import ObservationRecord
from projections.store.history import History
from projections.store.records import (
    Cause,
    Merge,
    ObjectHistory,
    ObjectMerge,
    PlaceHistory,
    count_before,
)

from .evidence import (
    evidence_document,
    evidence_entries,
    evidence_facts,
    evidence_text,
    standing_text,
    votes_text,
)
from .merges import merge_reason
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
        passed = _passed_milestone(before, change.keyframe_count)
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
    classes = Counter(
        o.class_name(end) for o in history.objects if o.stands(end) and o.place(end) == place
    )
    if not classes:
        return "no objects"
    most = sorted(classes.items(), key=lambda item: (-item[1], item[0]))
    named = ", ".join(name if count == 1 else f"{name} ×{count}" for name, count in most[:8])
    others = len(most) - 8
    more = f" and {others} more {'class' if others == 1 else 'classes'}" if others > 0 else ""
    return f"{counted(classes.total(), 'object')}: {named}{more}"


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


def explain_object(
    history: History,
    observation: Callable[[ObservationOrdinal], ObservationRecord],
    record: ObjectHistory,
    end: Offset,
) -> Explanation:
    """Explain an object by the events below ``end``."""
    seen = [observation(each.observation) for each in sightings_of(history, record, end)]
    votes = Counter(each.class_name for each in seen)
    entries = sorted(
        (e for e in _object_entries(history, observation, record) if e.cause.offset < end),
        key=lambda entry: entry.cause.offset,
    )
    return Explanation(
        kind="object",
        subject=record.object_id,
        summary=_object_summary(history, record, votes, end),
        entries=tuple(entries),
        facts={
            "class_name": record.class_name(end),
            "place_id": id_of_place(history, record.place(end)),
            "det_ids": [each.det_id for each in seen],
            **evidence_facts(record, votes, end),
        },
    )


def sightings_of(history: History, record: ObjectHistory, end: Offset) -> list[ObjectSeen]:
    """The sightings of an object and of those that it absorbed in the events below ``end``."""
    found = record.sightings[: count_before(record.sightings, end)]
    for merge in record.merges[: count_before(record.merges, end)]:
        found += sightings_of(history, history.objects[merge.absorbed], end)
    return sorted(found, key=lambda seen: seen.observation)


def _object_summary(
    history: History, record: ObjectHistory, votes: Counter[str], end: Offset
) -> str:
    last = record.values(end)
    if last is None:
        return "not seen yet"
    merge = record.absorbed_by
    if merge is not None and merge.offset < end:
        survivor = history.objects[merge.survivor].object_id
        return f"fused into {survivor} at offset {merge.offset:,} ({merge.cause.when})"
    x, y = mean_m(last.sum_x_um, last.obs_count), mean_m(last.sum_y_um, last.obs_count)
    sightings = sightings_of(history, record, end)
    least = min(seen.similarity_q40 for seen in sightings) / Q40
    similar = f" (similarity at least {least:.2f})" if last.obs_count > 1 else ""
    return (
        f"{record.class_name(end)}{_votes(record, votes)}, "
        f"seen {counted(last.obs_count, 'time')}{similar}, "
        f"on average from ({x:.2f}, {y:.2f}); in {place_title(history, record.place(end), end)}"
        f"{standing_text(history, record, end)}"
    )


def _votes(record: ObjectHistory, votes: Counter[str]) -> str:
    return votes_text(votes) if record.estimates else ""


def _object_entries(
    history: History,
    observation: Callable[[ObservationOrdinal], ObservationRecord],
    record: ObjectHistory,
) -> Iterator[Entry]:
    pose = history.keyframes[history.keyframe_count(Offset(record.found.offset + 1)) - 1].pose
    first = observation(record.sightings[0].observation).det_id
    yield Entry(
        record.cause,
        "found",
        f"new object: {first}, seen from {position_text(pose)}, "
        f"matched no {'object' if record.estimates else record.found.class_name} nearby",
        {"det_id": first},
    )
    yield from _sightings(history, record)
    yield from _moves(history, record)
    for merge in record.merges:
        absorbed = history.objects[merge.absorbed].object_id
        text = f"{absorbed} was fused into it {_why_fused(merge)}"
        yield Entry(merge.cause, "fused", text, {"object_id": absorbed, **_evidence_of(merge)})
    if (ended := record.absorbed_by) is not None:
        survivor = history.objects[ended.survivor].object_id
        text = f"fused into {survivor} {_why_fused(ended)}"
        yield Entry(ended.cause, "ended", text, {"object_id": survivor, **_evidence_of(ended)})
    for offset, what, text, facts in evidence_entries(record):
        yield Entry(history.cause_at(offset), what, text, facts)


def _why_fused(merge: ObjectMerge) -> str:
    evidence = merge.values.evidence
    return "by a command" if evidence is None else f"as one thing: {evidence_text(evidence)}"


def _evidence_of(merge: ObjectMerge) -> dict[str, Any]:
    evidence = merge.values.evidence
    return {} if evidence is None else {"evidence": evidence_document(evidence)}


def _sightings(history: History, record: ObjectHistory) -> Iterator[Entry]:
    before = 1
    for seen in record.sightings:
        if _passed_milestone(before, seen.obs_count):
            text = f"seen {counted(seen.obs_count, 'time')}"
            yield Entry(history.cause_at(seen.offset), "seen", text, {"obs_count": seen.obs_count})
        before = seen.obs_count


def _moves(history: History, record: ObjectHistory) -> Iterator[Entry]:
    before: PlaceOrdinal | None = None
    for moved in record.moves:
        cause = history.cause_at(moved.offset)
        facts = {"from": id_of_place(history, before), "to": id_of_place(history, moved.place)}
        yield Entry(cause, "located", _move_text(history, before, moved.place, moved.offset), facts)
        before = moved.place


def _move_text(
    history: History, before: PlaceOrdinal | None, after: PlaceOrdinal | None, offset: Offset
) -> str:
    to = place_name(history, after)
    if before is None:
        return f"located in {to}"
    merge = history.places[before].absorbed_by
    if merge is not None and merge.cause.offset == offset:
        return f"located in {to}, which absorbed {place_name(history, before)}"
    return f"located in {to} instead of {place_name(history, before)}: most sightings are there"


def position_text(pose: Pose | None) -> str:
    """``(x, y)`` of a pose in metres, or ``no pose``."""
    return "no pose" if pose is None else f"({pose.x_um / 1e6:.2f}, {pose.y_um / 1e6:.2f})"


def _passed_milestone(before: int, after: int) -> bool:
    """Whether a count passed one of 10, 20, 50, 100, 200, 500 …: growth that gets an entry."""
    return _milestones_up_to(after) > _milestones_up_to(before)


def _milestones_up_to(count: int) -> int:
    if count < 10:
        return 0
    digits = str(count)
    return 3 * (len(digits) - 2) + bisect_right("125", digits[0])
