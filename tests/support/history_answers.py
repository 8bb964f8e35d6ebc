"""Every answer of a timeline as plain data, and the same from a history in memory as the oracle."""

from collections.abc import Iterable
from typing import Any

from eventsrc.envelope.model import Offset
from projections.history import Timeline
from projections.history.diff import difference_of, rows_of
from projections.history.known import KnownHistory
from projections.history.merges import merge_document, object_merge_document, refusal_document
from projections.map.digest import map_digest
from projections.map.export import state_document, state_text
from projections.map.fold import fold_events
from projections.map.space_vectors import new_map
from projections.map.view import MapView
from tests.support.memory_history import MemoryHistory
from tests.support.past_view import view_at


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


def told(timeline: Timeline, ends: Iterable[int]) -> dict[str, Any]:
    """All answers of a timeline under all that is known."""
    known = timeline.knowing()
    return {"maps": maps(known, ends), **stories(known)}


def expected(timeline: Timeline, ends: Iterable[int]) -> dict[str, Any]:
    """The same from memory."""
    known = KnownInMemory(timeline.knowing())
    return {"maps": maps(known, ends), **stories(known)}
