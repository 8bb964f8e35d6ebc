"""The log becomes a map: folded here for the story, replayed into the databases for use.

The story wants to know which *rooms* became one when two places merged. The map knows no rooms; the
truth beside the run does: a part's room is the one most of its keyframes were truly taken in.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from eventsrc.log import LogReader
from eventsrc.sim import SimulatedRun
from projections.deltas import PlacesMerged
from projections.digest import map_digest
from projections.folding import fold_events, fold_log
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings
from projections.view import MapView

from .folder import DemoFolder


@dataclass(frozen=True, slots=True)
class Part:
    """A place before it merged: how many keyframes, and the room most of them were taken in."""

    place_id: str
    keyframes: int
    room: str


@dataclass(frozen=True, slots=True)
class MergeMoment:
    """The moment in which places became one.

    ``bridge_room`` is where its keyframe was taken, ``places_before`` how many there were then.
    """

    offset: int
    run_id: str
    keyframe_id: int
    bridge_room: str
    survivor: Part
    absorbed: tuple[Part, ...]
    places_before: int

    @property
    def across_rooms(self) -> bool:
        """Whether the parts were of different rooms."""
        return len({self.survivor.room, *(part.room for part in self.absorbed)}) > 1

    @property
    def smallest(self) -> int:
        """Keyframes of the smallest part."""
        return min(self.survivor.keyframes, *(part.keyframes for part in self.absorbed))


@dataclass(frozen=True, slots=True)
class Folded:
    """The map of the log, its merges with the rooms they joined, its digest, and the time taken."""

    view: MapView
    deltas: tuple[PlacesMerged, ...]
    merges: tuple[MergeMoment, ...]
    digest: str
    seconds: float


def fold_with_rooms(folder: DemoFolder, settings: Settings, run: SimulatedRun) -> Folded:
    """Fold the folder's log, looking at every merge as it happens."""
    started = time.monotonic()
    rooms = {line["keyframe_id"]: str(line["room"]) for line in run.truth}
    view = MapView(settings)
    deltas: list[PlacesMerged] = []
    moments: list[MergeMoment] = []
    with LogReader(folder.log) as reader:
        for event in fold_events(reader.read(), SemanticMap(settings)):
            for delta in event.deltas:
                if isinstance(delta, PlacesMerged):
                    deltas.append(delta)
                    moments.append(_moment(view, delta, rooms))
                view.apply(delta)
            view.advance(event.offset + 1)
    return Folded(view, tuple(deltas), tuple(moments), map_digest(view), time.monotonic() - started)


def places_with(folder: DemoFolder, settings: Settings) -> int:
    """How many places the same log makes with other settings."""
    with LogReader(folder.log) as reader:
        _, view = fold_log(reader, settings, keep_embeddings=False)
    return len(view.places)


def most_telling(merges: Sequence[MergeMoment]) -> MergeMoment | None:
    """The merge to tell about: of different rooms if there is one, with the largest small part."""
    return max(
        merges, key=lambda merge: (merge.across_rooms, merge.smallest, -merge.offset), default=None
    )


def _moment(view: MapView, delta: PlacesMerged, rooms: dict[int, str]) -> MergeMoment:
    """``view`` is as it was just before the merge, with the bridging keyframe already in it."""
    bridge = view.keyframes[delta.bridge]
    sizes = dict(zip(delta.absorbed, delta.absorbed_counts, strict=True))
    return MergeMoment(
        delta.offset,
        bridge.run_id,
        bridge.keyframe_id,
        rooms[bridge.keyframe_id],
        _part(view, delta.survivor, delta.survivor_count, rooms),
        tuple(_part(view, place, size, rooms) for place, size in sizes.items()),
        len(view.places),
    )


def _part(view: MapView, ordinal: int, size: int, rooms: dict[int, str]) -> Part:
    place = view.all_places[ordinal]
    seen = Counter(rooms[view.keyframes[member].keyframe_id] for member in place.members)
    return Part(place.place_id, size, max(sorted(seen), key=lambda room: seen[room], default="?"))
