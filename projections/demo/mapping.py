"""The log becomes a map: folded here for the story, replayed into the databases for use.

The story wants to know which *rooms* became one when two places merged. The map knows no rooms; the
truth beside the run does: a part's room is the one most of its keyframes were truly taken in.

The databases follow the log while it is recorded; later a replay must give the same rows.
"""

import statistics
import threading
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from psycopg import sql

from eventsrc.envelope import FIRST_OFFSET, Offset, RunId
from eventsrc.errors import MapfoldError
from eventsrc.log import LogReader
from eventsrc.sim import SimulatedRun
from projections.database import TailReport, rebuild, tail
from projections.database.connection import Targets, connect, database_errors
from projections.database.labels import GRAPH, LABELS, TABLE
from projections.deltas import PlacesMerged
from projections.model.digest import map_digest
from projections.model.fold import fold_events, fold_log
from projections.model.view import MapView
from projections.reducers.semantic_map import SemanticMap
from projections.settings import Settings

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
            view.advance(Offset(event.offset + 1))
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


_PATIENCE_S: Final = 30.0
_STEP_S: Final = 0.05


@dataclass(frozen=True, slots=True)
class Followed:
    """How the databases kept up: delays from an event's recording to its being readable there."""

    events: int
    batches: int
    median_delay_s: float
    worst_delay_s: float


class Follower:
    """A tail beside the recorder, in a thread of this process, for the length of a ``with`` block.

    It begins from an empty projection of this log, whatever the databases held before.
    """

    def __init__(self, log: Path, targets: Targets, settings: Settings) -> None:
        self._log, self._targets, self._settings = log, targets, settings
        self._stop = threading.Event()
        self._commits: list[tuple[Offset, int]] = []
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="tail")
        self._running: Future[TailReport] | None = None

    def __enter__(self) -> Self:
        rebuild(self._log, self._targets, self._settings, until=FIRST_OFFSET)
        self._running = self._pool.submit(
            tail, self._log, self._targets, self._settings, stop=self._stop, on_batch=self._note
        )
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._pool.shutdown()

    def caught_up(self, end: Offset) -> Followed:
        """Wait until ``end`` events are in the databases; tells how they kept up."""
        assert self._running is not None  # noqa: S101 - inside the with block
        deadline, pause = time.monotonic() + _PATIENCE_S, threading.Event()
        while not self._commits or self._commits[-1][0] < end:
            if self._running.done():
                self._running.result()  # raises what ended it
            if time.monotonic() > deadline:
                raise MapfoldError(
                    f"{self._log}: the databases did not reach event {end} within "
                    f"{_PATIENCE_S:g} s; run mapfold status {self._log}"
                )
            pause.wait(_STEP_S)
        self._stop.set()
        report = self._running.result(_PATIENCE_S)
        delays = self._delays()
        return Followed(report.events, report.batches, statistics.median(delays), max(delays))

    def _note(self, report: TailReport) -> None:
        self._commits.append((report.next_offset, time.time_ns()))

    def _delays(self) -> list[float]:
        """Seconds for every event, from the log's time stamp to the commit that covers it."""
        delays: list[float] = []
        commits = iter(self._commits)
        reached, committed_ns = 0, 0
        with LogReader(self._log) as reader:
            for event in reader.read(FIRST_OFFSET, self._commits[-1][0]):
                while reached <= event.offset:
                    reached, committed_ns = next(commits)
                delays.append((committed_ns - event.logged_ns) / 1e9)
        return delays


def fingerprint(targets: Targets) -> dict[str, str]:
    """For every table of graph and vectors a hash over all its rows, whatever their order.

    ``ingested_at`` is left out: it says when a row was written, not what is in it.
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
