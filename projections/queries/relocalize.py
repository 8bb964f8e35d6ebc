"""Re-localisation with the live databases, one round trip to each of them.

`relocalize` answers a whole question; a `CandidateReader` keeps the connections for several. The
candidates are ranked in `projections.relocalize`.

Graph and vectors are one map only if the same log and settings made both. Each has a checkpoint of
its own, and ``replay --only`` or ``tail --only`` may have made one of them from something else. The
numbers of observations then differ, and an answer made of both would be wrong; it is refused.
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
    reason = (
        f"made with other settings than the graph, both from log {log}"
        if log == graph_log
        else f"made from log {log}, the graph from log {graph_log}"
    )
    where = "" if vectors_place == graph_place else f" (the graph is in {graph_place})"
    raise ProjectionMismatch(
        f"{vectors_place}: the vectors there were {reason}{where}; run mapfold replay LOG without"
        " --only, so that one log and one set of settings make both"
    )


_LABEL_IDS = {"observation": LABEL_IDS["Observation"]}
_NUMBER_MASK = (1 << 48) - 1
_NEAR_COLUMNS = 12
"""Number of columns of the statement ``near``; the last two are embedding model and origin."""
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
    with CandidateReader(targets) as reader:
        return rank(crops, reader.candidates(crops), top=top, method=method, camera=camera)


def prepare_graph(connection: Connection) -> None:
    """Set up a session for joins of the graph's tables by id; ag_catalog comes last in the path.

    A question joins a few hundred ids. By default the planner reads whole tables into hashes for
    that: 300 ms instead of 10 at 300,000 observations.
    """
    connection.execute('SET search_path = "$user", public, ag_catalog')
    for setting in ("jit", "enable_hashjoin", "enable_mergejoin"):
        connection.execute(sql.SQL("SET {} = off").format(sql.Identifier(setting)))


def prepare_vectors(connection: Connection) -> None:
    """Set up a session for vector search: vectors in binary, a wider HNSW search.

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


class CandidateReader:
    """Connections to the databases of one projection, for one question after the other."""

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
        """The ``neighbours`` observations most similar to each crop, with their Places."""
        return fetch(self._vectors, self._graph, crops, neighbours)

    def disable_index(self) -> None:
        """From now on search exactly, without the HNSW index: slow."""
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
    """Candidates over open connections; with the same one twice in one round trip."""
    one = vectors is graph
    with _query_errors(vectors):
        rows = vectors.execute(
            _statement("near_and_graph" if one else "near", len(crops)),
            {**_LABEL_IDS, "neighbours": neighbours, **_crop_values(crops)},
        ).fetchall()
    _check_spaces(crops, rows)
    near = [(*row[:_NEAR_COLUMNS],) for row in rows]
    graph_rows = (
        {row[1]: row[_NEAR_COLUMNS:] for row in rows} if one else _follow_graph(graph, near)
    )
    if near:
        first = graph_rows.get(near[0][1], (None,))
        refuse_mixed(
            near[0][-1], first[-1], describe_connection(vectors), describe_connection(graph)
        )
    return _assemble(len(crops), near, graph_rows)


def _follow_graph(graph: Connection, near: Sequence[Sequence[Any]]) -> dict[int, tuple[Any, ...]]:
    det_pks = sorted({row[1] for row in near})
    with _query_errors(graph):
        rows = graph.execute(_statement("graph", 0), {**_LABEL_IDS, "det_pks": det_pks}).fetchall()
    return {row[0]: row[1:] for row in rows}


@lru_cache(maxsize=128)
def _statement(name: str, crops: int) -> sql.Composed:
    rows = [
        sql.SQL("({}::int, {}::vector)").format(sql.Literal(i), sql.Placeholder(f"crop_{i}"))
        for i in range(crops)
    ]
    questions = sql.SQL("VALUES {}").format(sql.SQL(", ").join(rows))
    return statements("relocalize")[name].format(questions=questions, **tables())


def _crop_values(crops: Sequence[Crop]) -> dict[str, Any]:
    return {f"crop_{i}": crop.vector for i, crop in enumerate(crops)}


def _assemble(
    crops: int, near: Sequence[Sequence[Any]], graph_rows: Mapping[int, Sequence[Any]]
) -> Candidates:
    matches: list[list[Match]] = [[] for _ in range(crops)]
    places: dict[PlaceOrdinal, CandidatePlace] = {}
    for crop, det_pk, det_id, run_id, similarity, class_name, bbox, x, y, yaw, *_ in near:
        thing, object_place_id, object_place, place_id, place, _ = graph_rows.get(
            det_pk, (None,) * 6
        )
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
                _spot(places, object_place_id, object_place),
                _spot(places, place_id, place),
            )
        )
    ordered = (tuple(sorted(row, key=lambda m: (-m.similarity, m.observation))) for row in matches)
    return Candidates(tuple(ordered), places)


def _spot(
    places: dict[PlaceOrdinal, CandidatePlace], graphid: str | None, properties: str | None
) -> PlaceOrdinal | None:
    if graphid is None or properties is None:
        return None
    ordinal = PlaceOrdinal((int(graphid) & _NUMBER_MASK) - 1)
    if ordinal not in places:
        place = _properties(properties)
        places[ordinal] = CandidatePlace(
            place["place_id"], place["centroid_x"], place["centroid_y"], place.get("name")
        )
    return ordinal


@lru_cache(maxsize=4096)
def _properties(agtype: str) -> dict[str, Any]:
    properties: dict[str, Any] = json.loads(agtype)
    return properties


def _check_spaces(crops: Sequence[Crop], rows: Sequence[Sequence[Any]]) -> None:
    model = next((row[_NEAR_COLUMNS - 2] for row in rows), None)
    for crop in crops:
        check_space(crop, 0 if crop.vector is None else len(crop.vector), model)


@contextlib.contextmanager
def _query_errors(connection: Connection) -> Iterator[None]:
    """Errors of a question that does not fit the map, or of a database without a map."""
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
