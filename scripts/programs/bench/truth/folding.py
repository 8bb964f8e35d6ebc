"""Fold a case's envelopes and time it."""

import time
from collections.abc import Iterator, Sequence

from eventsrc.base.machine import gc_paused
from eventsrc.envelope.ingest import Accepted
from eventsrc.envelope.occupancy_map import OccupancyMap
from projections.fold.deltas import Delta
from projections.fold.exact import unit_vectors
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.parsing import READ_AHEAD
from projections.map.view import MapView


def fold_timed(
    events: Sequence[Accepted], settings: Settings, walls: OccupancyMap | None = None
) -> tuple[MapView, float]:
    """The view of validated envelopes folded in order, after a map if one is given, and the seconds
    of processor time that unit vectors, fold and view took."""
    start = time.process_time()
    view = MapView(settings, keep_embeddings=False)
    for _ in fold_into(view, events, walls):
        pass
    return view, time.process_time() - start


def fold_into(
    view: MapView, events: Sequence[Accepted], walls: OccupancyMap | None = None
) -> Iterator[tuple[Accepted, Sequence[Delta]]]:
    """Fold envelopes into an empty view, after a map if one is given; each with its deltas."""
    semantic_map = SemanticMap(view.settings)
    if walls is not None:
        offset = semantic_map.next_offset
        view.apply_event(offset, semantic_map.use_map(offset, walls))
    with gc_paused():
        for first in range(0, len(events), READ_AHEAD):
            chunk = events[first : first + READ_AHEAD]
            units = iter(unit_vectors([v for accepted in chunk for v in accepted.vectors]))
            for accepted in chunk:
                offset = semantic_map.next_offset
                own = [next(units) for _ in accepted.vectors]
                deltas = semantic_map.fold(offset, accepted, own)
                view.apply_event(offset, deltas)
                yield accepted, deltas
