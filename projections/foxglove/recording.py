"""A recording of how a map came about, an MCAP file for Foxglove."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from foxglove import Context, open_mcap

from eventsrc.envelope import FIRST_OFFSET, Offset
from eventsrc.log import LogReader
from projections.corrections import NO_CORRECTIONS, Corrections
from projections.deltas import KeyframeAdded, MapGiven, PlacesMerged
from projections.model.fold import fold_event
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

from .messages import MapTopics, change_lines
from .moments import Moments

SCENES: Final = 500
"""Scenes of a recording unless ``every`` says otherwise; each holds the whole map."""


def write_recording(
    reader: LogReader,
    path: Path,
    settings: Settings,
    end: Offset,
    *,
    corrections: Corrections = NO_CORRECTIONS,
    every: int | None = None,
    progress: Callable[[int, int], None] = lambda *_: None,
) -> int:
    """Record the first ``end`` events and the maps that they make; returns the number of scenes.

    There is a scene after every ``every``-th event, after each merge of places and at the end; by
    default some 500. The same log gives the same bytes. ``path`` is replaced when all is written.
    Raises OSError where it cannot be written, FoldError at an event that cannot be folded.
    """
    moments = Moments(reader.read(FIRST_OFFSET, end))
    step = every or max(1, -(-end // SCENES))
    semantic_map = SemanticMap(settings, corrections=corrections)
    view = MapView(settings, keep_embeddings=False, corrections=corrections)
    context, merges, scenes = Context(), list[PlacesMerged](), 0
    partial = path.with_name(f"{path.name}.partial")
    try:
        with open_mcap(partial, context=context, allow_overwrite=True):
            topics = MapTopics(context)
            for event in reader.read(FIRST_OFFSET, end):
                now = moments.times_ns[event.offset]
                deltas = fold_event(event, semantic_map)
                view.apply_event(event.offset, deltas)
                topics.event(event, now)
                topics.changes(change_lines(view, deltas), now)
                for delta in deltas:
                    if isinstance(delta, MapGiven):
                        topics.walls(view, delta, now)
                if any(isinstance(delta, KeyframeAdded) for delta in deltas):
                    topics.robot(view, now)
                new = [delta for delta in deltas if isinstance(delta, PlacesMerged)]
                merges += new
                if new or view.next_offset % step == 0 or view.next_offset == end:
                    topics.scene(view, merges, now)
                    scenes += 1
                progress(view.next_offset, end)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return scenes
