"""Which keyframes made places one, gathered while a log is folded."""

from collections.abc import Iterable

from projections.deltas import PlacesMerged
from projections.folding import FoldedEvent
from projections.view import MapView

from .scene import Bridge, place_names, spot_of


def fold_with_merges(events: Iterable[FoldedEvent], view: MapView) -> list[PlacesMerged]:
    """Apply every event to ``view`` and return its merges, in offset order."""
    merges: list[PlacesMerged] = []
    for event in events:
        view.apply_event(event.offset, event.deltas)
        merges += (delta for delta in event.deltas if isinstance(delta, PlacesMerged))
    return merges


def bridges_of(view: MapView, merges: Iterable[PlacesMerged]) -> list[Bridge]:
    """One mark for each merge, where its bridging keyframe was taken."""
    names = place_names(view)
    marks: list[Bridge] = []
    for merge in merges:
        keyframe = view.keyframes[merge.bridge]
        spot = spot_of(keyframe)
        if spot is not None:
            absorbed = " and ".join(names[place] for place in merge.absorbed)
            text = f"{absorbed} into {names[merge.survivor]}, keyframe {keyframe.keyframe_id}"
            marks.append(Bridge(*spot, text))
    return marks
