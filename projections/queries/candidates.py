"""Candidates from the live databases: one round trip to each of them for crops with embeddings.

Crops without one are answered with observations of Objects of their class, which takes three more.

Graph and vectors are one map only if the same log and settings made both. Each has a checkpoint of
its own, and ``replay --only`` or ``tail --only`` may have made one of them from something else. The
numbers of observations then differ, and an answer made of both would be wrong; it is refused.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

import psycopg
from psycopg import sql

from projections.database.connection import Connection, database_errors, describe_connection
from projections.database.graph_render import text
from projections.database.labels import LABEL_IDS
from projections.database.statements import statements, tables
from projections.deltas import ObservationOrdinal, PlaceOrdinal
from projections.errors import ProjectionMismatch, ProjectionMissing, QuestionError
from projections.relocalize import NEIGHBOURS, CandidatePlace, Candidates, Crop, Match, Stand
from projections.relocalize.candidates import (
    OBSERVATIONS_OF_EACH,
    check_space,
    objects_of_a_class,
    refuse_unknown_classes,
)

from .known_constants import ConstantsMemory, KnownConstants

_NUMBER_MASK: Final = (1 << 48) - 1
_NEAR: Final = 13
"""Number of columns of the statement ``near``."""
_Rows = list[tuple[Any, ...]]


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


class CandidateSearch:
    """One question's search over open connections; the same one twice for one database."""

    def __init__(self, vectors: Connection, graph: Connection, memory: ConstantsMemory) -> None:
        self._vectors, self._graph, self._memory = vectors, graph, memory
        self._known: KnownConstants = memory.known

    def candidates(self, crops: Sequence[Crop], neighbours: int = NEIGHBOURS) -> Candidates:
        """The ``neighbours`` observations most similar to each crop, with their Places; of a crop
        without embedding observations of its class."""
        looked = [number for number, crop in enumerate(crops) if crop.vector is not None]
        named = [number for number, crop in enumerate(crops) if crop.vector is None]
        near: _Rows = []
        along: dict[int, tuple[Any, ...]] = {}
        if looked or not named:
            near, along = self._nearest([crops[number] for number in looked], neighbours)
            near = [(looked[crop], *row) for crop, *row in near]
        if named:
            of_classes, more = self._of_classes(crops, named)
            near, along = near + of_classes, along | more
        self._memory.known = self._known
        found = _assemble(len(crops), near, along, self._known)
        refuse_unknown_classes(crops, found.matches, self._class_names)
        return found

    def _nearest(
        self, crops: Sequence[Crop], neighbours: int
    ) -> tuple[_Rows, dict[int, tuple[Any, ...]]]:
        """Rows of crop, similarity, det_pk and what follows in ``near``; and those of `_follow`."""
        one = self._vectors is self._graph
        values: dict[str, Any] = {"neighbours": neighbours, "observation": LABEL_IDS["Observation"]}
        values |= {f"crop_{i}": crop.vector for i, crop in enumerate(crops)}
        with _query_errors(self._vectors):
            statement = _statement("near_and_graph" if one else "near", len(crops))
            rows = self._vectors.execute(statement, values | self._known.parameters).fetchall()
        near = self._near(rows)
        model = next((row[-1] for row in near), None)
        for crop in crops:
            check_space(crop, 0 if crop.vector is None else len(crop.vector), model)
        if not one:
            return near, self._follow([row[2] for row in near], rows)
        return near, self._along([row[_NEAR:] for row in rows], rows)

    def _of_classes(
        self, crops: Sequence[Crop], named: Sequence[int]
    ) -> tuple[_Rows, dict[int, tuple[Any, ...]]]:
        """The same for crops of which only the class is known; ``named`` are their numbers."""
        names = sorted({crops[number].class_name or "" for number in named})
        values: dict[str, Any] = {
            "patterns": [f'{{"class_name": {text(name)}}}' for name in names],
            "objects": objects_of_a_class(crops),
            "of_each": OBSERVATIONS_OF_EACH,
        }
        with _query_errors(self._graph):
            picked = self._graph.execute(_statement("of_classes"), values).fetchall()
        det_pks = sorted({det_pk for _, det_pk in picked})
        values = {"det_pks": det_pks, **self._known.parameters}
        with _query_errors(self._vectors):
            rows = self._vectors.execute(_statement("described"), values).fetchall()
        described = {row[2]: row[1:] for row in self._near(rows)}
        along = self._follow(det_pks, rows)
        by_class: dict[str, list[int]] = {}
        for place, det_pk in picked:
            by_class.setdefault(names[place - 1], []).append(det_pk)
        near = [
            (number, *described[det_pk])
            for number in named
            for det_pk in by_class.get(crops[number].class_name or "", ())
            if det_pk in described
        ]
        return near, along

    def _near(self, rows: _Rows) -> _Rows:
        """Learn the cosines; the rows from ``crop`` on that have an observation."""
        self._known = self._known.with_cosines(rows[0][0] if rows else None)
        return [row[2:_NEAR] for row in rows if row[4] is not None]

    def _follow(self, det_pks: Iterable[int], vectors: _Rows) -> dict[int, tuple[Any, ...]]:
        """Object and Places of observations; ``vectors`` are rows of the vectors' database."""
        values = {"det_pks": sorted(set(det_pks)), "observation": LABEL_IDS["Observation"]}
        with _query_errors(self._graph):
            rows = self._graph.execute(_statement("graph"), values | self._known.parameters)
            return self._along(rows.fetchall(), vectors)

    def _along(self, rows: _Rows, vectors: _Rows) -> dict[int, tuple[Any, ...]]:
        """Learn the settings and check the origin; what follows on ``det_pk``, by that."""
        if rows and vectors:
            places = describe_connection(self._vectors), describe_connection(self._graph)
            refuse_mixed(vectors[0][1], rows[0][1], *places)
            self._known = self._known.with_settings(rows[0][0], places[1])
        return {row[2]: row[3:] for row in rows if row[2] is not None}

    def _class_names(self) -> list[str]:
        with _query_errors(self._graph):
            rows = self._graph.execute(_statement("class_names")).fetchall()
        return [json.loads(row[0]) for row in rows if row[0] is not None]


@lru_cache(maxsize=128)
def _statement(name: str, crops: int = 0) -> sql.Composed:
    """``crops`` is the number of those that are searched for, in the statements that search."""
    rows = [
        sql.SQL("({}::int, {}::vector)").format(sql.Literal(i), sql.Placeholder(f"crop_{i}"))
        for i in range(crops)
    ]
    none = sql.SQL("SELECT 0, NULL::vector WHERE false")
    questions = sql.SQL("VALUES {}").format(sql.SQL(", ").join(rows)) if rows else none
    run = statements("relocalize")
    followed = run["followed"].format(**tables())
    return run[name].format(
        questions=questions,
        cosines=run["cosines"],
        settings=run["settings"],
        followed=followed,
        **tables(),
    )


def _assemble(
    crops: int, near: _Rows, along: Mapping[int, Sequence[Any]], known: KnownConstants
) -> Candidates:
    matches: list[list[Match]] = [[] for _ in range(crops)]
    places: dict[PlaceOrdinal, CandidatePlace] = {}
    for crop, similarity, det_pk, det_id, run_id, class_name, bbox, x, y, yaw, _ in near:
        thing, object_place_id, object_place, place_id, place = along.get(det_pk, (None,) * 5)
        found = None if thing is None else _properties(thing)
        matches[crop].append(
            Match(
                ObservationOrdinal(det_pk - 1),
                det_id,
                run_id,
                float(similarity),
                None if x is None else (x, y, yaw),
                (bbox[0], bbox[1], bbox[2], bbox[3]),
                class_name if found is None else found["class_name"],
                None if found is None else found["object_id"],
                _spot(places, object_place_id, object_place),
                _spot(places, place_id, place),
                None if found is None else _stand(found),
            )
        )
    ordered = (tuple(sorted(row, key=lambda m: (-m.similarity, m.observation))) for row in matches)
    return Candidates(tuple(ordered), places, known.constants)


def _stand(found: Mapping[str, Any]) -> Stand | None:
    """None under the page's rule, and for a map of an older version, which has no covariance."""
    if "est_xx" not in found:
        return None
    return Stand(
        found["est_x"],
        found["est_y"],
        found["est_xx"],
        found["est_xy"],
        found["est_yy"],
        found["est_spots"],
    )


def _spot(
    places: dict[PlaceOrdinal, CandidatePlace], graphid: str | None, properties: str | None
) -> PlaceOrdinal | None:
    if graphid is None or properties is None:
        return None
    ordinal = PlaceOrdinal((int(graphid) & _NUMBER_MASK) - 1)
    if ordinal not in places:
        place = _properties(properties)
        places[ordinal] = CandidatePlace(
            place["place_id"],
            place["centroid_x"],
            place["centroid_y"],
            place.get("name"),
            place.get("floor"),
        )
    return ordinal


@lru_cache(maxsize=4096)
def _properties(agtype: str) -> dict[str, Any]:
    properties: dict[str, Any] = json.loads(agtype)
    return properties


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
