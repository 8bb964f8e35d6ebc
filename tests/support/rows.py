"""Rows of a projection's tables, read from the server and computed from the view.

`expected_graph` is written for being obviously right, not fast, and shares nothing with the sinks
but the label numbering that docs/projections.md promises.

Rows of a log that is followed batch by batch, beside those of a rebuild, in memory.

A log to refold, a live tail beside a test, and the rows that a refold must leave.

Wait until the server has dropped what rebuilds replaced.
"""

import json
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from eventsrc.envelope.model import FIRST_OFFSET
from eventsrc.log import LogReader
from projections.fold.corrections import NO_CORRECTIONS, Corrections
from projections.fold.exact import Q40
from projections.fold.place_types import place_type
from projections.fold.settings import Settings
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.map.place_regions import place_regions
from projections.map.records import body_fields
from projections.map.view import MapView
from projections.postgres import TailProgress, TailReport, rebuild, tail
from projections.postgres.connection import Targets, connect
from projections.postgres.live_fold import LiveFold, batches
from projections.postgres.replaced_tables import wait_for_drop
from tests.support.logs import bridge, walk, write_log
from tests.support.memory_sink import MemorySink, MemoryTables

ORDER = (
    "Run", "Keyframe", "Pose", "Observation", "Object", "Place", "HAS_KEYFRAME", "HAS_POSE",
    "HAS_OBSERVATION", "OBSERVES", "LOCATED_IN", "IN_PLACE", "ADJACENT_TO",
    "Floor", "Building", "PART_OF",
)  # fmt: skip
VERTICES = (*ORDER[:6], "Floor", "Building")


def gid(label: str, number: int) -> str:
    """The graphid of a label's row, as text."""
    return str((3 + ORDER.index(label)) << 48 | number)


def graph_rows(url: str) -> dict[str, list[tuple[str, ...]]]:
    """All rows of the graph as text, by label, ordered by id."""
    vertex = sql.SQL("SELECT id::text, properties FROM {} ORDER BY id")
    edge = sql.SQL("SELECT id::text, start_id::text, end_id::text, properties FROM {} ORDER BY id")
    with psycopg.connect(url) as connection:
        connection.execute("SET search_path = ag_catalog, public")
        return {
            label: connection.execute(
                (vertex if label in VERTICES else edge).format(
                    sql.Identifier("semantic_map", label)
                )
            ).fetchall()
            for label in ORDER
        }


def parsed(rows: Mapping[str, Sequence[tuple[str, ...]]]) -> dict[str, list[tuple[Any, ...]]]:
    """`graph_rows` as `expected_graph` writes them: properties as dictionaries."""
    return {
        label: [(*row[:-1], json.loads(row[-1])) for row in found] for label, found in rows.items()
    }


def memory_rows(tables: MemoryTables) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of a graph in memory, as `expected_graph` writes them."""
    return parsed(
        {
            label: [(*map(str, row[:-1]), row[-1]) for _, row in sorted(found.items())]
            for label, found in tables.graph.items()
        }
    )


def vector_rows(url: str) -> list[tuple[Any, ...]]:
    """All rows of the table, embeddings as text, ordered by det_pk."""
    with psycopg.connect(url) as connection:
        connection.execute("SET timezone = 'UTC'")
        return connection.execute(
            "SELECT det_pk, run_id, det_id, keyframe_id, class_name, confidence, bbox, map_x,"
            " map_y, map_yaw, camera, embedding_model, embedding::text, ingested_at"
            " FROM detection_embeddings ORDER BY det_pk"
        ).fetchall()


def map_rows(url: str) -> list[tuple[Any, ...]]:
    """All rows of the table of occupancy maps, and the key that the checkpoint has for them."""
    with psycopg.connect(url) as connection:
        rows = connection.execute(
            "SELECT log_offset, floor, map_id, source, resolution, origin_x, origin_y, origin_yaw,"
            " width, height, png, digest FROM mapfold.occupancy_map ORDER BY log_offset"
        ).fetchall()
        key = "SELECT maps FROM mapfold.checkpoint WHERE sink = 'graph'"
        return rows + connection.execute(key).fetchall()


AllRows = tuple[Mapping[str, Any], list[tuple[Any, ...]], list[tuple[Any, ...]]]


def all_rows(targets: Targets) -> AllRows:
    """Every row of the graph, of the vectors and of the occupancy maps."""
    graph, vectors = graph_rows(targets.graph_url), vector_rows(targets.vector_url)
    return graph, vectors, map_rows(targets.graph_url)


def expected_graph(view: MapView) -> dict[str, list[tuple[Any, ...]]]:
    """Every row the graph must have, properties as dictionaries, ordered by id."""
    rows: dict[str, list[tuple[Any, ...]]] = {label: [] for label in ORDER}
    for run in view.runs:
        properties: dict[str, Any] = {"run_id": run.run_id, "started_at": run.started_at}
        rows["Run"].append((gid("Run", run.ordinal + 1), properties))
    for k in view.keyframes:
        n = k.ordinal + 1
        name = {"run_id": k.run_id, "keyframe_id": k.keyframe_id}
        taken: dict[str, Any] = {"timestamp": k.timestamp, "offset": k.offset}
        if k.camera is not None:
            taken["camera"] = {
                name: getattr(k.camera, name)
                for name in ("hfov_deg", "width_px", "height_px", "yaw_rad")
            }
        if k.frame is not None:
            taken |= {"frame": k.frame, "frame_joined": k.frame in view.frames}
        rows["Keyframe"].append((gid("Keyframe", n), {**name, **taken}))
        run_end = gid("Run", k.run + 1)
        rows["HAS_KEYFRAME"].append((gid("HAS_KEYFRAME", n), run_end, gid("Keyframe", n), {}))
        if k.pose is not None:
            at: dict[str, Any] = {"map_x": k.pose.x_um / 1e6, "map_y": k.pose.y_um / 1e6}
            at |= {"map_yaw": k.pose.yaw_rad} | ({} if k.floor is None else {"floor": k.floor})
            rows["Pose"].append((gid("Pose", n), {**name, **at}))
            rows["HAS_POSE"].append((gid("HAS_POSE", n), gid("Keyframe", n), gid("Pose", n), {}))
        if k.place is not None:
            place_end = gid("Place", k.place + 1)
            rows["IN_PLACE"].append((gid("IN_PLACE", n), gid("Keyframe", n), place_end, {}))
    _expect_objects(view, rows)
    for p in view.places.values():
        properties = {
            "place_id": p.place_id,
            "centroid_x": p.centroid_x,
            "centroid_y": p.centroid_y,
            "keyframe_count": p.keyframe_count,
        }
        if p.name is not None:
            properties["name"] = p.name
        floor = view.keyframes[p.founder].floor
        whole = gid("Building", 1)
        if floor is not None:
            properties["floor"] = floor
            whole = gid("Floor", 1 + list(view.floors).index(floor))
        kind = place_type(recounted_contents(view, p.ordinal), p.name)
        if kind is not None and kind.type is not None:
            properties |= {"type": kind.type, "type_probability": kind.probability}
        if (region := place_regions(view).get(p.ordinal)) is not None:
            geometry = json.dumps(region.geometry(), separators=(",", ":"))
            properties |= {"region": geometry, "area_m2": region.area_m2}
        n = p.ordinal + 1
        rows["PART_OF"].append((gid("PART_OF", n), gid("Place", n), whole, {}))
        rows["Place"].append((gid("Place", p.ordinal + 1), properties))
    for a, b, shared in view.edges():
        ends = gid("Place", a + 1), gid("Place", b + 1)
        number = (a + 1) << 24 | (b + 1)
        properties = {"shared_transitions": shared}
        founders = (view.keyframes[view.all_places[place].founder] for place in (a, b))
        if len({k.floor for k in founders}) > 1:
            properties["between_floors"] = True
        rows["ADJACENT_TO"].append((gid("ADJACENT_TO", number), *ends, properties))
    for number, floor in enumerate(view.floors, 1):
        rows["Floor"].append((gid("Floor", number), {"floor": floor}))
        ends = gid("Floor", number), gid("Building", 1)
        rows["PART_OF"].append((gid("PART_OF", 2**40 + number), *ends, {}))
    if view.floors or view.all_places:
        rows["Building"].append((gid("Building", 1), {"building_id": "building"}))
    return {label: sorted(found, key=lambda row: int(row[0])) for label, found in rows.items()}


def recounted_contents(view: MapView, place: int) -> dict[str, float]:
    """The weight of each class in a place: a quarter for an Object that was observed once."""
    counted: dict[str, float] = {}
    for found in view.objects.values():
        if found.place == place:
            weight = 1.0 if len(found.observations) > 1 else 0.25
            counted[found.class_name] = counted.get(found.class_name, 0.0) + weight
    return counted


def _expect_objects(view: MapView, rows: dict[str, list[tuple[Any, ...]]]) -> None:
    for o in view.observations:
        n, k = o.ordinal + 1, view.keyframes[o.keyframe]
        properties: dict[str, Any] = {
            "det_id": o.det_id,
            "class_name": o.class_name,
            "confidence": o.confidence,
            "bbox": list(o.bbox),
            "run_id": k.run_id,
            "keyframe_id": k.keyframe_id,
        }
        rows["Observation"].append((gid("Observation", n), properties))
        start = gid("Keyframe", o.keyframe + 1)
        rows["HAS_OBSERVATION"].append(
            (gid("HAS_OBSERVATION", n), start, gid("Observation", n), {})
        )
        if o.object is not None:
            ends = gid("Observation", n), gid("Object", o.object + 1)
            q40 = o.similarity_q40
            properties = {} if q40 is None else {"similarity": q40 / Q40}
            rows["OBSERVES"].append((gid("OBSERVES", n), *ends, properties))
    for obj in view.objects.values():
        n = obj.ordinal + 1
        properties = {
            "object_id": obj.object_id,
            "class_name": obj.class_name,
            "mean_x": obj.mean_x,
            "mean_y": obj.mean_y,
            "obs_count": obj.obs_count,
            "first_seen": obj.first_seen,
            "last_seen": obj.last_seen,
            "confirmed": obj.confirmed,
        }
        bodies = [view.observations[o].body for o in obj.observations]
        if any(body is not None for body in bodies):
            properties |= body_fields(view.body_of(obj))
        if view.settings.fusion == "evidence":
            properties["missing"] = obj.missing_in is not None
            if obj.missing_in is not None:
                properties["missing_in"] = view.runs[obj.missing_in].run_id
            if obj.relocations:
                moved = obj.relocations[-1]
                properties |= {
                    "moved_from_x": moved.from_x_um / 1e6,
                    "moved_from_y": moved.from_y_um / 1e6,
                    "moved_at": moved.offset,
                }
            if (at := obj.estimate) is not None:
                properties |= {"est_x": at.x_um / 1e6, "est_y": at.y_um / 1e6}
                properties["est_sigma_m"] = at.est_sigma_m
                properties |= {
                    "est_xx": at.var_xx_um2 / 1e12,
                    "est_xy": at.var_xy_um2 / 1e12,
                    "est_yy": at.var_yy_um2 / 1e12,
                    "est_spots": at.spots,
                }
        rows["Object"].append((gid("Object", n), properties))
        if obj.place is not None:
            ends = gid("Object", n), gid("Place", obj.place + 1)
            rows["LOCATED_IN"].append((gid("LOCATED_IN", n), *ends, {}))


def followed_and_rebuilt(
    log: Path, settings: Settings, size: int, corrections: Corrections = NO_CORRECTIONS
) -> tuple[MemoryTables, MemoryTables]:
    """The tables of a tail and those of a rebuild, both in batches of ``size`` events."""
    live, fresh = MemoryTables(), MemoryTables()
    following, folding = (LiveFold(settings, corrections=corrections) for _ in range(2))
    sink, shadow = MemorySink(), MemorySink().shadow()
    with LogReader(log) as reader:
        for batch in batches(reader.read(FIRST_OFFSET), size):
            assert not any(following.feed(batch))
            sink.prepare(following.tracker.drain(), following.view).send(live)
            assert not any(folding.feed(batch))
            shadow.load(folding.tracker.drain(), folding.view)(fresh)
    shadow.finish(folding.view)(fresh)
    shadow.swap_in(fresh)
    return live, fresh


SETTINGS = Settings()
WAIT_S = 60.0
LOG_LENGTH = 120


def three_rooms(folder: Path) -> Path:
    """A log of three rooms that the run b joins into one place, and a third run."""
    documents = walk(60) + list(bridge()) + walk(40, seed=3, run_id="run-c")
    return write_log(folder / "log", documents)


def fresh_rows(log: Path, targets: Targets, **options: Any) -> Any:
    """The rows of a replay, which must also be those that the view of a plain fold asks for."""
    rebuild(log, targets, SETTINGS, **options)
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        _, view = fold_log(reader, SETTINGS, corrections=corrections)
    found = all_rows(targets)
    assert parsed(found[0]) == expected_graph(view)
    return found


@contextmanager
def tailing(
    log: Path, targets: Targets, **options: Any
) -> Iterator[tuple[TailProgress, "Future[TailReport]"]]:
    """A live tail in a thread, stopped at the end."""
    progress, stop = TailProgress(), threading.Event()
    with ThreadPoolExecutor(1) as pool:
        running = pool.submit(
            tail, log, targets, options.pop("settings", SETTINGS), stop=stop, progress=progress,
            **options,
        )  # fmt: skip
        try:
            yield progress, running
        finally:
            stop.set()
            running.result(WAIT_S)


def wait_for_drops(targets: Targets) -> None:
    """Wait until the sessions that drop have ended, in all databases of the target."""
    for url in {targets.graph_url, targets.vector_url}:
        with connect(url) as connection:
            wait_for_drop(connection, "graph")
            wait_for_drop(connection, "vectors")
