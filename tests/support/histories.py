"""Every answer of a timeline as plain data, and the same from a history in memory as the oracle.

A process of its own that asks a log for its history, for tests that limit or kill it.

The map at any offset, made from the records of a history, one by one.
"""

import json
import os
import resource
import signal
import sys
import zipfile
from bisect import bisect_left
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any, Literal
from unittest.mock import patch

from msgspec.structs import replace

from eventsrc.envelope.model import Offset
from projections.fold.deltas import PlaceOrdinal
from projections.fold.pair_groups import PlaceSurvivors
from projections.fold.settings import Settings
from projections.history import LogTimeline
from projections.history.diff import difference_of, rows_of
from projections.history.known_history import KnownHistory
from projections.history.merge_reasons import (
    merge_document,
    object_merge_document,
    refusal_document,
)
from projections.map.digest import map_digest
from projections.map.fold import fold_events, new_map
from projections.map.records import (
    KeyframeRecord,
    ObjectRecord,
    ObservationRecord,
    PlaceRecord,
    RunRecord,
    confirm,
)
from projections.map.state_output import state_document, state_text
from projections.map.view import MapView
from projections.store.history import History
from projections.store.history_records import count_before, last_before
from tests.support.memory_history import MemoryHistory, object_of


class KnownInMemory(KnownHistory):
    """A `KnownHistory` that folds the log into records in memory: no tables, no cache."""

    def __init__(self, known: KnownHistory) -> None:
        super().__init__(known.reader, known.settings, known.corrections, cache=False)
        self._records = MemoryHistory(known.settings, known.corrections)
        self._view = MapView(known.settings, keep_embeddings=False, corrections=known.corrections)
        semantic_map = new_map(known.reader, known.settings, known.corrections)
        for folded in fold_events(known.reader.read(), semantic_map):
            self._view.apply_event(folded.offset, folded.deltas)
            self._records.apply(folded.offset, folded.deltas)

    @property
    def history(self) -> Any:
        return self._records

    def covering(self, end: Offset) -> Any:
        return self._records

    def _whole_view(self, history: Any) -> Any:
        return self._view

    def at(self, end: Offset | None = None) -> MapView:
        return view_at(self._records, self._view, self.end if end is None else end)


def whole(view: MapView) -> dict[str, Any]:
    """Everything that a view says."""
    return {
        **state_document(view, map_digest(view)),
        "text": state_text(view, ""),
        "rows": rows_of(view),
        "members": {p.place_id: p.members for p in view.all_places},
        "names": [(p.name, p.name_offset) for p in view.all_places],
        "all places": [(p.place_id, view.survivors.find(p.ordinal)) for p in view.all_places],
        "observations": [(o.object, o.similarity_q40, o.embedding_crc) for o in view.observations],
        "of keyframes": [tuple(k.observations) for k in view.keyframes],
        "all objects": [(o.object_id, o.observations, o.obs_count) for o in view.all_objects],
        "types": [view.type_of(place) for place in view.places],
        "skipped": {kind: count for kind, count in view.skipped.items() if count},
        "floors": view.floors,
        "next": view.next_offset,
    }


def maps(known: KnownHistory, ends: Iterable[int]) -> list[dict[str, Any]]:
    """The map at each of ``ends``."""
    return [whole(known.at(Offset(end))) for end in ends]


def stories(known: KnownHistory) -> dict[str, Any]:
    """What is said about merges, places, objects and keyframes."""
    history = known.history
    names = [f"{k.run_id}:{k.keyframe_id}" for k in history.keyframes]
    pairs = list(zip(names, names[3:], strict=False))[::5]
    last = known.at()
    first = known.at(Offset(known.end // 2))
    return {
        "merges": [merge_document(history, merge) for merge in known.merges()],
        "refusals": [refusal_document(history, refusal) for refusal in known.refusals()],
        "object merges": [object_merge_document(history, each) for each in known.object_merges()],
        "places": [known.why(each).document() for each in history.place_ordinals],
        "objects": [known.why(each).document() for each in history.object_ordinals],
        "searches": searches(known, names),
        "pairs": [known.why_same(*pair).document() for pair in pairs],
        "diff": difference_of(first, last, {}, ()).document(),
        "diff back": difference_of(last, first, {}, ()).document(),
        "skipped": list(history.skipped),
        "runs": history.runs,
        "edges": {pair: list(changes) for pair, changes in history.edges.items()},
        "placed": [list(history.placed_offsets), list(history.placed_in)],
        "ordinals": dict(history.keyframe_ordinals),
    }


def searches(known: KnownHistory, names: list[str]) -> list[dict[str, Any]]:
    """When conditions turned true, each asked by a scan and, where that can do, by bisection."""
    history = known.history
    conditions = ["noise_count > 2", "place_count == 2", "keyframe_count > 5"]
    conditions += [f"place_of({name!r}) != none" for name in names[:1]]
    conditions += [f"same_place({a!r}, {b!r})" for a, b in zip(names, names[4:5], strict=False)]
    conditions += [f"keyframe_count({runs[0].run_id!r}) > 3" for runs in history.runs]
    conditions += [f"size({name!r}) > 4" for name in list(history.place_ordinals)[:2]]
    conditions += [f"sightings({name!r}) > 2" for name in list(history.object_ordinals)[:2]]
    return [
        known.bisect(condition, scan=scan).document()
        for condition in conditions
        for scan in (False, True)
    ]


def told(timeline: LogTimeline, ends: Iterable[int]) -> dict[str, Any]:
    """All answers of a timeline under all that is known."""
    known = timeline.knowing()
    return {"maps": maps(known, ends), **stories(known)}


def expected(timeline: LogTimeline, ends: Iterable[int]) -> dict[str, Any]:
    """The same from memory."""
    known = KnownInMemory(timeline.knowing())
    return {"maps": maps(known, ends), **stories(known)}


RULES = Settings(eps_m=0.7, min_samples=3, fusion_radius_m=2.0)
FILE_BYTES = 20_000
"""What a file may take at most for a process whose disk is full."""


def answers(log: Path, notes: list[str]) -> str:
    """Some answers as text; the history is kept however short it is."""
    with (
        patch("projections.store.timeline_cache.MIN_EVENTS", 1),
        LogTimeline(log, RULES, note=notes.append) as timeline,
    ):
        history = timeline.history
        merges = [merge_document(history, merge) for merge in timeline.merges()]
        digests = [map_digest(timeline.at(end)) for end in range(0, timeline.end, 60)]
    return json.dumps([merges, digests])


def main() -> None:
    """Print the answers of a log to stdout and the notes to stderr. ``full`` limits the size of
    files, ``killed N`` ends this process by SIGKILL when it has written the N-th array."""
    log, how = Path(sys.argv[1]), sys.argv[2]
    if how == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, FILE_BYTES))
    if how == "killed":
        _die_at_array(int(sys.argv[3]))
    notes: list[str] = []
    sys.stdout.write(answers(log, notes))
    sys.stderr.write("\n".join(notes))


def _die_at_array(number: int) -> None:
    begin, begun = zipfile.ZipFile.open, [0]

    def count(archive: zipfile.ZipFile, name: zipfile.ZipInfo, mode: Literal["w"]) -> IO[bytes]:
        begun[0] += 1
        if begun[0] > number:
            os.kill(os.getpid(), signal.SIGKILL)
        return begin(archive, name, mode)

    patch.object(zipfile.ZipFile, "open", count).start()


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
    view.has_bodies = any(each.body is not None for each in view.observations)
    view.all_objects = _objects(history, end)
    for merge in history.object_merges[: count_before(history.object_merges, end)]:
        view.object_survivors.merge(merge.survivor, (merge.absorbed,))
    absorbed = view.object_survivors.absorbed_by
    view.objects = {o.ordinal: o for o in view.all_objects if o.ordinal not in absorbed}
    for found in view.objects.values():
        view.contents.update(found)
        confirm(found, found.observations, view.observations, view.keyframes)
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
            k.camera,
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
    records = [object_of(each, end) for each in history.objects[:count]]
    for merge in history.object_merges:
        if merge.offset < end:
            survivor, absorbed = records[merge.survivor], records[merge.absorbed]
            survivor.observations = sorted(survivor.observations + absorbed.observations)
            absorbed.observations = []
            relocations = survivor.relocations + absorbed.relocations
            survivor.relocations = sorted(relocations, key=lambda r: (r.offset, r.observation))
            absorbed.relocations = []
    return records


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
