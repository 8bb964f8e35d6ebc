"""A map at any offset, taken from a history: no fold, only reading.

Makes the `MapView` that applying every delta below ``end`` makes. What one event settles for good
is shared between all such views (observations, poses); what later events change (places, where a
keyframe joined, objects) is made anew, so views never disturb each other.
"""

from bisect import bisect_left

from eventsrc.envelope import Offset
from projections.deltas import PlaceOrdinal
from projections.model.view import (
    KeyframeRecord,
    MapView,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    RunRecord,
)
from projections.reducers.survivors import PlaceSurvivors
from projections.settings import Settings

from .history import History
from .records import ObjectLife, count_before, last_before


def view_at(history: History, latest: MapView, end: Offset, settings: Settings) -> MapView:
    """The map after the events below ``end``; ``latest`` is a view of at least as many events."""
    view = MapView(settings, keep_embeddings=latest.keep_embeddings)
    view.all_places = _places(history, end)
    view.survivors = _survivors(history, end)
    absorbed_by = view.survivors.absorbed_by
    view.places = {p.ordinal: p for p in view.all_places if p.ordinal not in absorbed_by}
    view.keyframes = _keyframes(history, latest, view.survivors, end)
    view.observations = _observations(history, latest, end)
    view.objects = _objects(history, end)
    view.runs = _runs(history, view.keyframes, end)
    view.adjacency = _adjacency(history, end)
    for skipped in history.skipped[: count_before(history.skipped, end)]:
        view.skipped[skipped.kind] += 1
    view.advance(end)
    return view


def _places(history: History, end: Offset) -> list[PlaceRecord]:
    lives = history.places[: bisect_left(history.places, end, key=lambda p: p.formed.offset)]
    records = []
    for life in lives:
        formed = life.formed
        record = PlaceRecord(formed.place, formed.place_id, formed.founder, formed.offset)
        record.unordered_members = [
            d.keyframe for d in life.joined[: count_before(life.joined, end)]
        ]
        if (change := life.change(end)) is not None:
            record.keyframe_count = change.keyframe_count
            record.sum_x_um, record.sum_y_um = change.sum_x_um, change.sum_y_um
        records.append(record)
    _merge(history, records, end)
    return records


def _merge(history: History, records: list[PlaceRecord], end: Offset) -> None:
    """Hand members on to survivors, in the order in which the merges happened."""
    for merge in history.merges:
        if merge.cause.offset >= end:
            return
        survivor = records[merge.survivor]
        for place in merge.absorbed:
            absorbed = records[place]
            survivor.unordered_members += absorbed.unordered_members
            absorbed.unordered_members = []


def _survivors(history: History, end: Offset) -> PlaceSurvivors:
    survivors = PlaceSurvivors()
    for merge in history.merges:
        if merge.cause.offset < end:
            survivors.merge(merge.survivor, merge.absorbed)
    return survivors


def _keyframes(
    history: History, latest: MapView, survivors: PlaceSurvivors, end: Offset
) -> list[KeyframeRecord]:
    count = history.keyframe_count(end)
    return [
        KeyframeRecord(
            k.ordinal,
            k.offset,
            k.run,
            k.run_id,
            k.keyframe_id,
            k.timestamp,
            k.pose,
            survivors,
            k.observations,
            place if placed < end else None,
        )
        for k, placed, place in zip(
            latest.keyframes[:count], history.placed_offsets, history.placed_in, strict=False
        )
    ]


def _observations(history: History, latest: MapView, end: Offset) -> list[ObservationRecord]:
    keyframes = history.keyframe_count(end)
    return latest.observations[
        : bisect_left(latest.observations, keyframes, key=lambda o: o.keyframe)
    ]


def _objects(history: History, end: Offset) -> list[ObjectRecord]:
    count = bisect_left(history.objects, end, key=lambda o: o.found.offset)
    return [_object(life, end) for life in history.objects[:count]]


def _object(life: ObjectLife, end: Offset) -> ObjectRecord:
    found, seen = life.found, life.seen[: count_before(life.seen, end)]
    record = ObjectRecord(found.object, found.object_id, found.class_name)
    record.observations = [delta.observation for delta in seen]
    if seen:
        last = seen[-1]
        record.obs_count = last.obs_count
        record.sum_x_um, record.sum_y_um = last.sum_x_um, last.sum_y_um
        record.first_seen, record.last_seen = last.first_seen, last.last_seen
    record.place = life.place(end)
    return record


def _runs(history: History, keyframes: list[KeyframeRecord], end: Offset) -> list[RunRecord]:
    records = []
    for seen in history.runs:
        last = last_before(seen, end)
        if last is not None:
            records.append(RunRecord(last.run, last.run_id, last.started_at))
    for keyframe in keyframes:
        records[keyframe.run].keyframe_count += 1
    return records


def _adjacency(history: History, end: Offset) -> dict[tuple[PlaceOrdinal, PlaceOrdinal], int]:
    found = ((pair, last_before(linked, end)) for pair, linked in history.edges.items())
    return {
        pair: last.shared_transitions
        for pair, last in found
        if last is not None and last.shared_transitions
    }
