"""Re-localisation against the live databases: one round trip, or two when they are apart.

A `Reader` holds the connections and fetches candidates; `relocalize` is the whole question from
databases to answer. What the ranking does with the candidates is `projections.relocalize`.

Graph and vectors are one map only if the same log and the same settings made both.

Each carries a checkpoint of its own, and ``replay --only`` or ``tail --only`` may have made one of
them from something else. Numbers of observations then name other things on the other side, and an
answer made of both would be wrong without anybody noticing.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Self

import psycopg
from pgvector.psycopg import register_vector
from psycopg import sql

from projections.database.connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_connection,
)
from projections.database.labels import LABEL_IDS
from projections.database.statements import statements, tables
from projections.deltas import ObservationOrdinal, PlaceOrdinal
from projections.errors import (
    ExtensionMissing,
    ProjectionMismatch,
    ProjectionMissing,
    QuestionError,
)
from projections.relocalize import (
    DEFAULT_CAMERA,
    NEIGHBOURS,
    Answer,
    Camera,
    CandidatePlace,
    Candidates,
    Crop,
    Match,
    Method,
    rank,
)
from projections.relocalize.candidates import check_space


def refuse_mixed(
    vectors: str | None, graph: str | None, vectors_place: str, graph_place: str
) -> None:
    """Raise ProjectionMismatch unless both origins, each ``log id, space, fingerprint``, agree."""
    if vectors is None or graph is None or vectors == graph:
        return
    log, _, _ = vectors.rpartition(" ")
    graph_log, _, _ = graph.rpartition(" ")
    told = (
        f"made with other settings than the graph, both from log {log}"
        if log == graph_log
        else f"made from log {log}, the graph from log {graph_log}"
    )
    where = "" if vectors_place == graph_place else f" (the graph is in {graph_place})"
    raise ProjectionMismatch(
        f"{vectors_place}: the vectors there were {told}{where}; run mapfold replay LOG without"
        " --only, so that one log and one set of settings make both"
    )


_LABELS = {"observation": LABEL_IDS["Observation"]}
_NUMBER = (1 << 48) - 1
_NEAR = 12
"""Columns of the statement ``near``; the last two: the embedding's model, and the origin."""
_EF_SEARCH = max(100, NEIGHBOURS)


def relocalize(
    targets: Targets,
    crops: Sequence[Crop],
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera = DEFAULT_CAMERA,
) -> Answer:
    """Where a robot is that sees ``crops``, from the databases as they are now."""
    with Reader(targets) as reader:
        return rank(crops, reader.candidates(crops), top=top, method=method, camera=camera)


def prepare_graph(connection: Connection) -> None:
    """Set up a session for walking along the graph's tables; AGE's operators are found last.

    A question follows a few hundred ids. Left alone the planner reads whole tables into hashes for
    that: 300 ms instead of 10 at 300,000 observations.
    """
    connection.execute('SET search_path = "$user", public, ag_catalog')
    for setting in ("jit", "enable_hashjoin", "enable_mergejoin"):
        connection.execute(sql.SQL("SET {} = off").format(sql.Identifier(setting)))


def prepare_vectors(connection: Connection) -> None:
    """Set up a session for searching: vectors in binary, enough breadth.

    Without a wider ``ef_search`` an HNSW index silently returns fewer rows than asked for.
    """
    try:
        register_vector(connection)
    except psycopg.ProgrammingError:
        raise ExtensionMissing(
            f"{describe_connection(connection)}: nothing has been projected there yet, not even"
            " the extension vector is created; run mapfold replay"
        ) from None
    connection.execute("SELECT '[1]'::vector")  # loads the library, whose settings come next
    connection.execute(sql.SQL("SET hnsw.ef_search = {}").format(sql.Literal(_EF_SEARCH)))


class Reader:
    """Connections to the databases of one projection, for questions one after the other."""

    def __init__(self, targets: Targets) -> None:
        self._targets = targets
        self._vectors = connect(targets.vector_url, application="mapfold query", autocommit=True)
        self._graph = self._vectors
        try:
            with database_errors(targets.vector_url):
                prepare_vectors(self._vectors)
            if not targets.one_database:
                self._graph = connect(
                    targets.graph_url, application="mapfold query", autocommit=True
                )
            prepare_graph(self._graph)
        except BaseException:
            self._vectors.close()
            raise

    def candidates(self, crops: Sequence[Crop], neighbours: int = NEIGHBOURS) -> Candidates:
        """The observations most like each crop, with their places."""
        return fetch(self._vectors, self._graph, crops, neighbours)

    def exactly(self) -> None:
        """From now on search without the index: slow, and never wrong."""
        self._vectors.execute("SET enable_indexscan = off")

    def close(self) -> None:
        """Close the connections. May be called twice."""
        self._vectors.close()
        self._graph.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def fetch(
    vectors: Connection, graph: Connection, crops: Sequence[Crop], neighbours: int = NEIGHBOURS
) -> Candidates:
    """Candidates over open connections; the same one twice means one round trip."""
    one = vectors is graph
    with _clear_errors(vectors):
        rows = vectors.execute(
            _statement("near_and_along" if one else "near", len(crops)),
            {**_LABELS, "neighbours": neighbours, **_bound(crops)},
        ).fetchall()
    _check_spaces(crops, rows)
    near = [(*row[:_NEAR],) for row in rows]
    along = {row[1]: row[_NEAR:] for row in rows} if one else _along(graph, near)
    if near:
        first = along.get(near[0][1], (None,))
        refuse_mixed(
            near[0][-1], first[-1], describe_connection(vectors), describe_connection(graph)
        )
    return _assemble(len(crops), near, along)


def _along(graph: Connection, near: Sequence[Sequence[Any]]) -> dict[int, tuple[Any, ...]]:
    det_pks = sorted({row[1] for row in near})
    with _clear_errors(graph):
        rows = graph.execute(_statement("along", 0), {**_LABELS, "det_pks": det_pks}).fetchall()
    return {row[0]: row[1:] for row in rows}


@lru_cache(maxsize=128)
def _statement(name: str, crops: int) -> sql.Composed:
    rows = [
        sql.SQL("({}::int, {}::vector)").format(sql.Literal(i), sql.Placeholder(f"crop_{i}"))
        for i in range(crops)
    ]
    questions = sql.SQL("VALUES {}").format(sql.SQL(", ").join(rows))
    return statements("relocalize")[name].format(questions=questions, **tables())


def _bound(crops: Sequence[Crop]) -> dict[str, Any]:
    return {f"crop_{i}": crop.vector for i, crop in enumerate(crops)}


def _assemble(
    crops: int, near: Sequence[Sequence[Any]], along: Mapping[int, Sequence[Any]]
) -> Candidates:
    matches: list[list[Match]] = [[] for _ in range(crops)]
    places: dict[PlaceOrdinal, CandidatePlace] = {}
    for crop, det_pk, det_id, run_id, similarity, class_name, bbox, x, y, yaw, *_ in near:
        thing, its_id, its, there_id, there, _ = along.get(det_pk, (None,) * 6)
        found = None if thing is None else _properties(thing)
        matches[crop].append(
            Match(
                ObservationOrdinal(det_pk - 1),
                det_id,
                run_id,
                similarity,
                None if x is None else (x, y, yaw),
                (bbox[0], bbox[1], bbox[2], bbox[3]),
                class_name if found is None else found["class_name"],
                None if found is None else found["object_id"],
                _spot(places, its_id, its),
                _spot(places, there_id, there),
            )
        )
    ordered = (tuple(sorted(row, key=lambda m: (-m.similarity, m.observation))) for row in matches)
    return Candidates(tuple(ordered), places)


def _spot(
    places: dict[PlaceOrdinal, CandidatePlace], graphid: str | None, properties: str | None
) -> PlaceOrdinal | None:
    if graphid is None or properties is None:
        return None
    ordinal = PlaceOrdinal((int(graphid) & _NUMBER) - 1)
    if ordinal not in places:
        place = _properties(properties)
        places[ordinal] = CandidatePlace(
            place["place_id"], place["centroid_x"], place["centroid_y"]
        )
    return ordinal


@lru_cache(maxsize=4096)
def _properties(agtype: str) -> dict[str, Any]:
    properties: dict[str, Any] = json.loads(agtype)
    return properties


def _check_spaces(crops: Sequence[Crop], rows: Sequence[Sequence[Any]]) -> None:
    model = next((row[_NEAR - 2] for row in rows), None)
    for crop in crops:
        check_space(crop, len(crop.vector), model)


@contextlib.contextmanager
def _clear_errors(connection: Connection) -> Iterator[None]:
    """What can be wrong with a question, or with a database that holds no map yet."""
    with database_errors(connection.info.dsn):
        try:
            yield
        except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
            raise ProjectionMissing(
                f"{describe_connection(connection)}: nothing has been projected there yet; run"
                " mapfold replay"
            ) from None
        except psycopg.errors.DataException as error:
            raise QuestionError(
                f"the question does not fit the map: {error.diag.message_primary}; ask with the"
                " model that made the map"
            ) from None
