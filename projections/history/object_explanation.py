"""Explain an object by its history, event by event.

Of an object of fusion by evidence also where it stands and how sure that is, the votes of classes,
since when it is missing and where it moved.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

from eventsrc.base.text import counted
from eventsrc.envelope.model import Offset
from projections.fold.deltas import ObjectMissing, ObjectSeen, ObservationOrdinal, PlaceOrdinal
from projections.fold.exact import Q40, UM_PER_M
from projections.map.records import EstimatedPosition, ObjectRecord, ObservationRecord
from projections.store.history import History
from projections.store.history_records import ObjectHistory, ObjectMerge, count_before

from .explanation import Entry, Explanation, passed_milestone, position_text
from .merge_reasons import evidence_document, evidence_text
from .names import id_of_place, place_name, place_title


def explain_object(
    history: History,
    observation: Callable[[ObservationOrdinal], ObservationRecord],
    record: ObjectHistory,
    end: Offset,
) -> Explanation:
    """Explain an object by the events below ``end``."""
    seen = [observation(each.observation) for each in sightings_of(history, record, end)]
    votes = Counter(each.class_name for each in seen)
    now = history.object_at(record.found.object, end)
    entries = sorted(
        (e for e in _object_entries(history, observation, record) if e.cause.offset < end),
        key=lambda entry: entry.cause.offset,
    )
    return Explanation(
        kind="object",
        subject=record.object_id,
        summary=_object_summary(history, record, now, votes, end),
        entries=tuple(entries),
        facts={
            "class_name": now.class_name,
            "place_id": id_of_place(history, now.place),
            "det_ids": [each.det_id for each in seen],
            **_evidence_facts(now, votes),
        },
    )


def sightings_of(history: History, record: ObjectHistory, end: Offset) -> list[ObjectSeen]:
    """The sightings of an object and of those that it absorbed in the events below ``end``."""
    found = record.sightings[: count_before(record.sightings, end)]
    for merge in record.merges[: count_before(record.merges, end)]:
        found += sightings_of(history, history.objects[merge.absorbed], end)
    return sorted(found, key=lambda seen: seen.observation)


def _object_summary(
    history: History, record: ObjectHistory, now: ObjectRecord, votes: Counter[str], end: Offset
) -> str:
    if not now.obs_count:
        return "not seen yet"
    merge = record.absorbed_by
    if merge is not None and merge.offset < end:
        survivor = history.objects[merge.survivor].object_id
        return f"fused into {survivor} at offset {merge.offset:,} ({merge.cause.when})"
    sightings = sightings_of(history, record, end)
    q40s = [seen.similarity_q40 for seen in sightings if seen.similarity_q40 is not None]
    similar = f" (similarity at least {min(q40s) / Q40:.2f})" if len(q40s) > 1 else ""
    return (
        f"{now.class_name}{_votes_text(votes) if record.estimates else ''}, "
        f"seen {counted(now.obs_count, 'time')}{similar}, on average from "
        f"({now.mean_x:.2f}, {now.mean_y:.2f}); in {place_title(history, now.place, end)}"
        f"{_standing_text(history, record, now, end)}"
    )


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
    for offset, what, text, facts in _evidence_entries(record):
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
        if passed_milestone(before, seen.obs_count):
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


def _standing_text(history: History, record: ObjectHistory, now: ObjectRecord, end: Offset) -> str:
    """``; stands at (1.20, 3.40) ± 0.12 m, seen from 3 spots; missing since …``; empty without an
    estimate."""
    if now.estimate is None:
        return ""
    text = f"; stands at {_where(now.estimate)}, seen from {counted(now.estimate.spots, 'spot')}"
    since = _missing_since(record, end)
    if since is not None:
        cause = history.cause_at(since)
        text += (
            f"; missing since offset {since:,} ({cause.title}): "
            f"not seen in {counted(now.misses, 'keyframe')} that should show it"
        )
    return text


def _votes_text(votes: Counter[str]) -> str:
    """`` (chair ×5, stool ×1)`` where classes differ, else nothing."""
    if len(votes) < 2:
        return ""
    return f" ({', '.join(f'{name} ×{count}' for name, count in _ordered(votes))})"


def _evidence_facts(now: ObjectRecord, votes: Counter[str]) -> dict[str, Any]:
    """The object's estimate, votes of classes and presence as JSON."""
    if now.estimate is None:
        return {}
    return {
        "estimate": _estimate_document(now.estimate),
        "class_counts": dict(_ordered(votes)),
        "missing": now.missing_in is not None,
        "misses": now.misses,
    }


def _estimate_document(at: EstimatedPosition) -> dict[str, Any]:
    return {"x": at.est_x, "y": at.est_y, "sigma_m": at.est_sigma_m, "spots": at.spots}


def _ordered(votes: Counter[str]) -> list[tuple[str, int]]:
    return sorted(votes.items(), key=lambda item: (-item[1], item[0]))


def _evidence_entries(
    record: ObjectHistory,
) -> Iterator[tuple[Offset, str, str, dict[str, Any]]]:
    """Offset, kind, text and facts of each of the object's events that only fusion by evidence
    has."""
    spots = 0
    for d in record.estimates:
        if _is_milestone(spots, d.spots):
            at = EstimatedPosition(
                d.x_um, d.y_um, d.var_xx_um2, d.var_xy_um2, d.var_yy_um2, d.spots
            )
            text = f"stands at {_where(at)}, seen from {counted(d.spots, 'spot')}"
            yield d.offset, "estimated", text, _estimate_document(at)
        spots = max(spots, d.spots)
    name = record.found.class_name
    for classified in record.classes:
        if classified.class_name != name:
            text = f"called {classified.class_name} instead of {name}: most sightings say so"
            yield classified.offset, "classified", text, {"from": name, "to": classified.class_name}
            name = classified.class_name
    was_missing = False
    for offset, looked in _presence(record):
        is_missing = looked is not None and looked.missing
        if looked is not None and is_missing and not was_missing:
            text = f"missing: not seen in {counted(looked.misses, 'keyframe')} that should show it"
            yield offset, "missing", text, {"misses": looked.misses}
        elif looked is not None and was_missing and not is_missing:
            yield offset, "back", "seen where it was missing", {}
        was_missing = is_missing
    for moved in record.relocations:
        start, stop = (moved.from_x_um, moved.from_y_um), (moved.to_x_um, moved.to_y_um)
        text = (
            f"moved {math.dist(start, stop) / UM_PER_M:.2f} m, "
            f"from {_point(start)} to {_point(stop)}"
        )
        facts = {
            "from": [value / UM_PER_M for value in start],
            "to": [value / UM_PER_M for value in stop],
        }
        yield moved.offset, "moved", text, facts


def _presence(record: ObjectHistory) -> list[tuple[Offset, ObjectMissing | None]]:
    """The object's missed sightings by offset, with None for each relocation, in order."""
    moved = [(each.offset, None) for each in record.relocations]
    looked = [(each.offset, each) for each in record.misses]
    return sorted([*moved, *looked], key=lambda event: event[0])


def _missing_since(record: ObjectHistory, end: Offset) -> Offset | None:
    """The event below ``end`` since which the object is missing; None if it is not."""
    since = None
    for offset, looked in _presence(record):
        if offset >= end:
            break
        if looked is None or not looked.missing:
            since = None
        elif since is None:
            since = offset
    return since


def _is_milestone(before: int, after: int) -> bool:
    """Whether a number of spots passed one of 1, 2, 3, 5, 10, 100 …"""
    return any(before < step <= after for step in (1, 2, 3, 5)) or (
        after >= 10 and len(str(after)) > len(str(before))
    )


def _where(at: EstimatedPosition) -> str:
    return f"{_point((at.x_um, at.y_um))} ± {at.est_sigma_m:.2f} m"


def _point(position_um: tuple[int, int]) -> str:
    x, y = (value / UM_PER_M for value in position_um)
    return f"({x:.2f}, {y:.2f})"
