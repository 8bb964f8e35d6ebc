"""The log folded to a map, its merges with the rooms they joined, and hashes of the databases.

The map knows no rooms; the truth beside the run does. A part's room is the one most of its
keyframes were truly taken in.
"""

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from psycopg import sql

from eventsrc.adapters.sim import SimulatedRun
from eventsrc.envelope.model import Offset, RunId
from eventsrc.log import LogReader
from projections.fold.deltas import PlacesMerged
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_events, fold_log
from projections.map.own_events import new_map, read_corrections
from projections.map.view import MapView
from projections.postgres.connection import Targets, connect, database_errors
from projections.postgres.labels import GRAPH, LABELS, TABLE

from .folder import DemoFolder


@dataclass(frozen=True, slots=True)
class Part:
    """A place before it merged: how many keyframes, and the room most of them were taken in."""

    place_id: str
    keyframes: int
    room: str


@dataclass(frozen=True, slots=True)
class RoomMerge:
    """A merge of places.

    ``bridge_room`` is where its keyframe was taken, ``places_before`` how many there were then.
    """

    offset: Offset
    run_id: RunId
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
    merges: tuple[RoomMerge, ...]
    digest: str
    seconds: float


def fold_with_rooms(folder: DemoFolder, settings: Settings, run: SimulatedRun) -> Folded:
    """Fold the folder's log under its commands, and note the rooms of every merge."""
    started = time.monotonic()
    rooms = {line["keyframe_id"]: str(line["room"]) for line in run.truth}
    deltas: list[PlacesMerged] = []
    merges: list[RoomMerge] = []
    with LogReader(folder.log) as reader:
        corrections = read_corrections(reader)
        view = MapView(settings, corrections=corrections)
        for event in fold_events(reader.read(), new_map(reader, settings, corrections)):
            for delta in event.deltas:
                if isinstance(delta, PlacesMerged):
                    deltas.append(delta)
                    merges.append(_room_merge(view, delta, rooms))
                view.apply(delta)
            view.advance(Offset(event.offset + 1))
    return Folded(view, tuple(deltas), tuple(merges), map_digest(view), time.monotonic() - started)


def places_with(folder: DemoFolder, settings: Settings) -> int:
    """How many places the same log makes with other settings."""
    with LogReader(folder.log) as reader:
        _, view = fold_log(reader, settings, keep_embeddings=False)
    return len(view.places)


def most_telling(merges: Sequence[RoomMerge]) -> RoomMerge | None:
    """The merge to describe: of different rooms if there is one, with the largest small part."""
    return max(
        merges, key=lambda merge: (merge.across_rooms, merge.smallest, -merge.offset), default=None
    )


def _room_merge(view: MapView, delta: PlacesMerged, rooms: dict[int, str]) -> RoomMerge:
    """``view`` is as it was just before the merge, with the bridging keyframe already in it."""
    bridge = view.keyframes[delta.bridge]
    sizes = dict(zip(delta.absorbed, delta.absorbed_counts, strict=True))
    return RoomMerge(
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


def hash_tables(targets: Targets) -> dict[str, str]:
    """For every table of graph and vectors a hash over all its rows, in any order.

    ``ingested_at``, the time a row was written, is left out.
    """
    tables = [(targets.graph_url, sql.Identifier(GRAPH, label)) for label in LABELS]
    tables.append((targets.vector_url, sql.Identifier("public", TABLE)))
    hashes: dict[str, str] = {}
    for url, table in tables:
        with database_errors(url), connect(url, application="mapfold demo") as connection:
            row = connection.execute(
                sql.SQL(
                    "SELECT count(*), md5(string_agg(line, '|' ORDER BY line)) FROM"
                    " (SELECT (to_jsonb(t.*) - 'ingested_at')::text AS line FROM {} AS t) AS lines"
                ).format(table)
            ).fetchone()
        hashes[table.as_string()] = repr(row)
    return hashes
