"""The map of the databases as a `MapView`, so that it is asked as a map folded from a log is.

It has what the graph has: all but embeddings, detections, corrections and what the log rejected.
Places and Objects that were absorbed are not in the graph: the others get new ordinals, in the
same order.
"""

import json
from collections.abc import Iterable
from typing import Any

import numpy as np
from psycopg import sql

from eventsrc.base.text import advised
from eventsrc.envelope.model import KeyframeId, Offset, RunId, StatedCamera
from projections.ask.words import ObjectVectors
from projections.fold import deltas
from projections.fold.exact import UM_PER_M, UNIT, metres_to_um
from projections.fold.map_errors import ProjectionMismatch
from projections.fold.settings import Settings
from projections.map import records
from projections.map.view import MapView
from projections.postgres import checkpoints, map_table
from projections.postgres.connection import (
    Connection,
    Targets,
    connect,
    describe_connection,
    statements,
    tables,
)
from projections.postgres.labels import number_of

from .candidate_search import prepare_graph
from .graph_reads import map_errors

_UM2_PER_M2 = 1e12


class LiveView(MapView):
    """A map read from the graph's database, made from the log ``log_id``. Its Objects have no
    observations: `seen_by` gives their keyframes."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings, keep_embeddings=False)
        self.log_id: str | None = None
        self.seen_in: dict[int, list[deltas.KeyframeOrdinal]] = {}

    def seen_by(self, found: records.ObjectRecord) -> list[deltas.KeyframeOrdinal]:
        """The ordinals of `sightings`."""
        return self.seen_in.get(found.ordinal, [])


def read_view(connection: Connection) -> LiveView:
    """The map as one transaction sees it; ``connection`` was set up by `prepare_graph`.

    Raises ProjectionMissing, and ProjectionMismatch for the graph of an older mapfold.
    """
    with map_errors(connection.info.dsn), connection.transaction():
        connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ, READ ONLY")
        for setting in ("enable_hashjoin", "enable_mergejoin"):  # it joins whole tables
            connection.execute(sql.SQL("SET LOCAL {} = on").format(sql.Identifier(setting)))
        kept = checkpoints.load(connection, "graph")
        rows = {
            name: connection.execute(statements("objects")[name].format(**tables())).fetchall()
            for name in ("runs", "places", "edges", "objects", "keyframes", "sightings")
        }
        settings = Settings() if kept is None else Settings.model_validate_json(kept.settings)
        view = LiveView(settings)
        for floor, given in map_table.read_with_key(connection)[1].items():
            view.maps[floor] = deltas.MapGiven(Offset(0), given)
    if kept is not None:
        view.log_id = kept.log_id
        view.advance(kept.next_offset)
    try:
        _fill(view, rows)
    except KeyError as error:
        raise ProjectionMismatch(
            f"{describe_connection(connection)}: the graph there has no property {error}: an older"
            f" mapfold made it; run `{advised('replay')}`, which makes it again"
        ) from None
    return view


def live_view(targets: Targets) -> LiveView:
    """The map of databases, over a connection of its own."""
    with _connection(targets.graph_url) as graph:
        prepare_graph(graph)
        return read_view(graph)


def live_vectors(targets: Targets) -> ObjectVectors:
    """`read_object_vectors`, over connections of its own."""
    with _connection(targets.graph_url) as graph, _connection(targets.vector_url) as vectors:
        prepare_graph(graph)
        return read_object_vectors(graph, vectors)


def _connection(url: str) -> Connection:
    return connect(url, application="mapfold find", autocommit=True)


def read_object_vectors(graph: Connection, vectors: Connection) -> ObjectVectors:
    """The mean vectors of the Objects of a map; with one database both are one connection."""
    with map_errors(graph.info.dsn):
        ids, names, seen, things = graph.execute(
            statements("objects")["object_observations"].format(**tables()), binary=True
        ).fetchall()[0]
    with map_errors(vectors.info.dsn), vectors.transaction():
        vectors.execute("SET LOCAL enable_hashjoin = on")
        rows = vectors.execute(
            statements("vectors")["mean_vectors"],
            {"det_pks": [number_of(each) for each in seen], "things": things},
            binary=True,
        ).fetchall()
    called = dict(zip(ids, names, strict=True))
    means = np.array([mean for _, mean, _ in rows], np.float64).reshape(len(rows), -1)
    model = rows[0][2] if rows else None
    return ObjectVectors(tuple(called[thing] for thing, _, _ in rows), means * UNIT, model)


def _fill(view: LiveView, rows: dict[str, list[Any]]) -> None:
    runs = _numbers(row[0] for row in rows["runs"])
    for ordinal, (_, properties) in enumerate(rows["runs"]):
        run = json.loads(properties)
        view.runs.append(
            records.RunRecord(deltas.RunOrdinal(ordinal), RunId(run["run_id"]), run["started_at"])
        )
    places = _numbers(row[0] for row in rows["places"])
    for ordinal, (_, properties) in enumerate(rows["places"]):
        place = _place(deltas.PlaceOrdinal(ordinal), json.loads(properties))
        view.all_places.append(place)
        view.places[place.ordinal] = place
    for a, b, properties in rows["edges"]:
        pair = deltas.PlaceOrdinal(places[a]), deltas.PlaceOrdinal(places[b])
        view.adjacency[pair] = json.loads(properties)["shared_transitions"]
    _fill_keyframes(view, rows["keyframes"], runs, places)
    run_of = {run.run_id: run.ordinal for run in view.runs}
    objects = _numbers(row[0] for row in rows["objects"])
    for ordinal, (_, properties, place_id) in enumerate(rows["objects"]):
        found = _object(deltas.ObjectOrdinal(ordinal), json.loads(properties), run_of)
        found.place = None if place_id is None else deltas.PlaceOrdinal(places[place_id])
        view.all_objects.append(found)
        view.objects[found.ordinal] = found
        view.contents.update(found)
    keyframes = _numbers(row[0] for row in rows["keyframes"])
    for thing, keyframe in rows["sightings"]:
        ordinal = deltas.KeyframeOrdinal(keyframes[keyframe])
        view.seen_in.setdefault(objects[thing], []).append(ordinal)


def _numbers(graphids: Iterable[str]) -> dict[str, int]:
    """The new number of each row."""
    return {graphid: number for number, graphid in enumerate(graphids)}


def _fill_keyframes(
    view: LiveView, rows: list[Any], runs: dict[str, int], places: dict[str, int]
) -> None:
    """The keyframes, and what Places have of them: members, founder and floor."""
    for ordinal, (_, run, properties, posed, place_id) in enumerate(rows):
        known = json.loads(properties)
        pose, floor = None, None
        if posed is not None:
            at = json.loads(posed)
            pose = deltas.Pose(metres_to_um(at["map_x"]), metres_to_um(at["map_y"]), at["map_yaw"])
            floor = at.get("floor")
        keyframe = records.KeyframeRecord(
            deltas.KeyframeOrdinal(ordinal),
            Offset(known["offset"]),
            deltas.RunOrdinal(runs[run]),
            RunId(known["run_id"]),
            KeyframeId(known["keyframe_id"]),
            known["timestamp"],
            pose,
            view.survivors,
            joined=None if place_id is None else deltas.PlaceOrdinal(places[place_id]),
            floor=floor,
            camera=StatedCamera(**known["camera"]) if "camera" in known else None,
        )
        view.keyframes.append(keyframe)
        view.runs[keyframe.run].keyframe_count += 1
        if floor is not None:
            view.floors.setdefault(floor, len(view.floors))
        if keyframe.joined is not None:
            place = view.all_places[keyframe.joined]
            if not place.unordered_members:
                place.founder, place.founded_offset = keyframe.ordinal, keyframe.offset
            place.unordered_members.append(keyframe.ordinal)


def _place(ordinal: deltas.PlaceOrdinal, known: dict[str, Any]) -> records.PlaceRecord:
    count = known["keyframe_count"]
    return records.PlaceRecord(
        ordinal,
        known["place_id"],
        deltas.KeyframeOrdinal(0),
        Offset(0),
        count,
        round(known["centroid_x"] * count * UM_PER_M),
        round(known["centroid_y"] * count * UM_PER_M),
        known.get("name"),
    )


def _object(
    ordinal: deltas.ObjectOrdinal, known: dict[str, Any], run_of: dict[RunId, deltas.RunOrdinal]
) -> records.ObjectRecord:
    count = known["obs_count"]
    found = records.ObjectRecord(
        ordinal,
        known["object_id"],
        known["class_name"],
        count,
        round(known["mean_x"] * count * UM_PER_M),
        round(known["mean_y"] * count * UM_PER_M),
        known["first_seen"],
        known["last_seen"],
        confirmed=known["confirmed"],
    )
    if "est_x" in known:
        xx, xy, yy = (round(known[f"est_{each}"] * _UM2_PER_M2) for each in ("xx", "xy", "yy"))
        at = metres_to_um(known["est_x"]), metres_to_um(known["est_y"])
        found.estimate = records.EstimatedPosition(*at, xx, xy, yy, known["est_spots"])
    if known.get("missing"):
        found.missing_in = run_of[known["missing_in"]]
    if "moved_at" in known:
        before = metres_to_um(known["moved_from_x"]), metres_to_um(known["moved_from_y"])
        now = metres_to_um(found.spot[0]), metres_to_um(found.spot[1])
        moved = records.Relocation(
            Offset(known["moved_at"]), deltas.ObservationOrdinal(0), *before, *now
        )
        found.relocations.append(moved)
    return found
