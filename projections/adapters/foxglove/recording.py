"""A recording of how a map came about, an MCAP file for Foxglove."""

from pathlib import Path

from foxglove import Context, open_mcap

from projections.fold.deltas import KeyframeAdded, MapGiven
from projections.map.change_lines import change_lines
from projections.map.scenes import RecordedFold

from .messages import MapTopics


def write_recording(fold: RecordedFold, path: Path) -> int:
    """Record a fold's events and the maps that they make; returns the number of scenes.

    The same log gives the same bytes. ``path`` is replaced when all is written. Raises OSError
    where it cannot be written, FoldError at an event that cannot be folded.
    """
    context, scenes = Context(), 0
    partial = path.with_name(f"{path.name}.partial")
    try:
        with open_mcap(partial, context=context, allow_overwrite=True):
            topics = MapTopics(context)
            for event, now, deltas, is_scene in fold:
                topics.event(event, now)
                topics.changes(change_lines(fold.view, deltas), now)
                for delta in deltas:
                    if isinstance(delta, MapGiven):
                        topics.walls(fold.view, delta, now)
                if any(isinstance(delta, KeyframeAdded) for delta in deltas):
                    topics.robot(fold.view, now)
                if is_scene:
                    topics.scene(fold.view, fold.merges, now)
                    scenes += 1
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return scenes
