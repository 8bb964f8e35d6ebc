"""The map at any offset, made from the records of a history, one by one."""

from bisect import bisect_left

from msgspec.structs import astuple, replace

from eventsrc.envelope.model import Offset
from projections.fold.deltas import PlaceOrdinal
from projections.fold.survivors import PlaceSurvivors
from projections.map.records import (
    Estimate,
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    Relocation,
    RunRecord,
)
from projections.map.view import MapView
from projections.store.history import History
from projections.store.records import ObjectHistory, count_before, last_before


def view_at(history: History, latest: MapView, end: Offset) -> MapView:
    """The `MapView` that applying every delta below ``end`` makes, without folding.

    ``latest`` is a view of at least as many events. Values that never change after their event
    (observations, poses) are shared with it; places, objects and the place of a keyframe are
    copied, so that changing one view does not change another.
    """
    view = MapView(
        history.settings,
        keep_embeddings=latest.keep_embeddings,
        corrections=history.corrections,
    )
    view.all_places = _places(history, end)
    view.survivors = _survivors(history, end)
    absorbed_by = view.survivors.absorbed_by
    view.places = {p.ordinal: p for p in view.all_places if p.ordinal not in absorbed_by}
    view.keyframes = _keyframes(history, latest, view.survivors, end)
    for keyframe in view.keyframes:
        if keyframe.floor is not None:
            view.floors.setdefault(keyframe.floor, len(view.floors))
    view.observations = _observations(history, latest, end)
    view.all_objects = _objects(history, end)
    for merge in history.object_merges[: count_before(history.object_merges, end)]:
        view.object_survivors.merge(merge.survivor, (merge.absorbed,))
    absorbed = view.object_survivors.absorbed_by
    view.objects = {o.ordinal: o for o in view.all_objects if o.ordinal not in absorbed}
    for found in view.objects.values():
        view.contents.update(found)
    view.runs = _runs(history, view.keyframes, end)
    view.adjacency = _adjacency(history, end)
    for skipped in history.skipped[: count_before(history.skipped, end)]:
        view.skipped[skipped.kind] = view.skipped.get(skipped.kind, 0) + 1
    for given in history.maps[: count_before(history.maps, end)]:
        view.maps[given.map.floor] = given
    view.advance(end)
    return view


def _places(history: History, end: Offset) -> list[PlaceRecord]:
    count = bisect_left(history.places, end, key=lambda p: p.formed.offset)
    records = []
    for place in history.places[:count]:
        formed = place.formed
        record = PlaceRecord(formed.place, formed.place_id, formed.founder, formed.offset)
        record.unordered_members = [
            d.keyframe for d in place.joined[: count_before(place.joined, end)]
        ]
        if (change := place.change(end)) is not None:
            record.keyframe_count = change.keyframe_count
            record.sum_x_um, record.sum_y_um = change.sum_x_um, change.sum_y_um
        if (named := last_before(place.names, end)) is not None:
            record.name, record.name_offset = named.name, named.command
        records.append(record)
    _apply_merges(history, records, end)
    return records


def _apply_merges(history: History, records: list[PlaceRecord], end: Offset) -> None:
    """Move members to the survivors, in the order of the merges."""
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
            k.floor,
        )
        for k, placed, place in zip(
            latest.keyframes[:count], history.placed_offsets, history.placed_in, strict=False
        )
    ]


def _observations(history: History, latest: MapView, end: Offset) -> list[ObservationRecord]:
    keyframes = history.keyframe_count(end)
    found = latest.observations[
        : bisect_left(latest.observations, keyframes, key=lambda o: o.keyframe)
    ]
    if not history.object_merges:
        return found
    # A merge of objects changes the object of observations: here they are not shared.
    objects = {
        seen.observation: history.object_survivor(each.found.object, end)
        for each in history.objects
        for seen in each.sightings
    }
    return [replace(o, object=objects.get(o.ordinal)) for o in found]


def _objects(history: History, end: Offset) -> list[ObjectRecord]:
    count = bisect_left(history.objects, end, key=lambda o: o.found.offset)
    records = [_object(each, end) for each in history.objects[:count]]
    for merge in history.object_merges:
        if merge.offset < end:
            survivor, absorbed = records[merge.survivor], records[merge.absorbed]
            survivor.observations = sorted(survivor.observations + absorbed.observations)
            absorbed.observations = []
            relocations = survivor.relocations + absorbed.relocations
            survivor.relocations = sorted(relocations, key=lambda r: (r.offset, r.observation))
            absorbed.relocations = []
    return records


def _object(history: ObjectHistory, end: Offset) -> ObjectRecord:
    found, seen = history.found, history.sightings[: count_before(history.sightings, end)]
    record = ObjectRecord(found.object, found.object_id, history.class_name(end))
    record.observations = [delta.observation for delta in seen]
    if (last := history.values(end)) is not None:
        record.obs_count = last.obs_count
        record.sum_x_um, record.sum_y_um = last.sum_x_um, last.sum_y_um
        record.first_seen, record.last_seen = last.first_seen, last.last_seen
    record.place = history.place(end)
    if (estimated := last_before(history.estimates, end)) is not None:
        _, _, *values = astuple(estimated)
        record.estimate = Estimate(*values)
    if (looked := history.looked_for(end)) is not None:
        record.misses = looked.misses
        record.missing_in = looked.run if looked.missing else None
    for moved in history.relocations[: count_before(history.relocations, end)]:
        offset, _, *values = astuple(moved)
        record.relocations.append(Relocation(offset, *values))
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
