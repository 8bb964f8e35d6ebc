"""Candidates from the live databases, in one round trip to each for crops with embeddings.

Crops without one are answered with observations of Objects of their class, which takes three more.

Graph and vectors are one map only if the same log and settings made both. Each has a checkpoint of
its own, and ``replay --only`` or ``tail --only`` may have made one of them from something else. The
numbers of observations then differ, and an answer made of both would be wrong, so the question is
refused.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
import psycopg
from psycopg import sql

from eventsrc.base.advised import advised
from projections.fold.deltas import ObservationOrdinal, PlaceOrdinal
from projections.fold.errors import ProjectionMismatch, ProjectionMissing, QuestionError
from projections.localize.relocalize import (
    NEIGHBOURS,
    CandidatePlace,
    MapCandidates,
    Match,
    ObjectEstimate,
    QuestionCrop,
)
from projections.localize.relocalize.candidates import (
    OBSERVATIONS_OF_EACH,
    check_space,
    objects_of_a_class,
    refuse_unknown_classes,
)
from projections.localize.relocalize.question import Box
from projections.postgres.connection import Connection, Targets, database_errors, describe_target
from projections.postgres.graph_render import text
from projections.postgres.labels import LABEL_IDS
from projections.postgres.map_table import read_with_key
from projections.postgres.statements import statements, tables

from .known_constants import ConstantsMemory, KnownConstants

_NUMBER_MASK: Final = (1 << 48) - 1
_NEAR: Final = 12
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
        f"{vectors_place}: the vectors there were {reason}{where}; run"
        f" `{advised('replay')}` without --only, so that one log and one set of settings make both"
    )


class CandidateSearch:
    """One question's search over open connections to ``targets``; with one database both are the
    same connection."""

    def __init__(
        self,
        targets: Targets,
        vectors: Connection,
        graph: Connection,
        memory: ConstantsMemory,
    ) -> None:
        self._targets, self._memory = targets, memory
        self._vectors, self._graph = vectors, graph
        self._known: KnownConstants = memory.known

    def candidates(
        self, crops: Sequence[QuestionCrop], neighbours: int = NEIGHBOURS
    ) -> MapCandidates:
        """The ``neighbours`` observations most similar to each crop, with their Places; of a crop
        without embedding observations of its class."""
        looked = [number for number, crop in enumerate(crops) if crop.vector is not None]
        named = [number for number, crop in enumerate(crops) if crop.vector is None]
        near: _Rows = []
        linked = _NOTHING
        if looked or not named:
            near, linked = self._nearest([crops[number] for number in looked], neighbours)
            if named:
                near = [(looked[crop], *row) for crop, *row in near]
        if named:
            of_classes, more = self._of_classes(crops, named)
            near, linked = near + of_classes, linked.union(more)
        self._memory.known = self._known
        found = _assemble(len(crops), near, linked, self._known)
        refuse_unknown_classes(crops, found.matches, self._class_names)
        return found

    def try_question(self) -> None:
        """Ask a question of one observation that is stored, if there is one. Raises DatabaseError
        when questions cannot be answered."""
        with _query_errors(self._targets.vector_url):
            row = self._vectors.execute(
                "SELECT embedding::real[] FROM public.detection_embeddings LIMIT 1", binary=True
            ).fetchone()
        if row is not None:
            self.candidates([QuestionCrop(np.array(row[0], np.float32))])

    def _nearest(self, crops: Sequence[QuestionCrop], neighbours: int) -> "tuple[_Rows, _Linked]":
        """Rows of crop, similarity, det_pk and further columns of ``near``; and their Objects and
        Places."""
        one = self._vectors is self._graph
        values: dict[str, Any] = {"observation": LABEL_IDS["Observation"]}
        values |= {f"crop_{i}": crop.vector for i, crop in enumerate(crops)}
        with _query_errors(self._targets.vector_url):
            statement = _statement("near_and_graph" if one else "near", len(crops), neighbours)
            values |= self._known.parameters
            rows = self._vectors.execute(statement, values, binary=True).fetchall()
        near, origin = self._near(rows)
        model = next((row[-1] for row in near), None)
        for crop in crops:
            check_space(crop, 0 if crop.vector is None else len(crop.vector), model)
        if not one:
            return near, self._follow([row[2] for row in near], origin)
        of_graph = next((row[_NEAR:] for row in rows if row[_NEAR] is not None), None)
        return near, _NOTHING if of_graph is None else self._linked(of_graph, origin)

    def _of_classes(
        self, crops: Sequence[QuestionCrop], named: Sequence[int]
    ) -> "tuple[_Rows, _Linked]":
        """As `_nearest`, for crops of which only the class is known; ``named`` are their
        indices."""
        names = sorted({crops[number].class_name or "" for number in named})
        values: dict[str, Any] = {
            "patterns": [f'{{"class_name": {text(name)}}}' for name in names],
            "objects": objects_of_a_class(crops),
            "of_each": OBSERVATIONS_OF_EACH,
        }
        with _query_errors(self._targets.graph_url):
            picked = self._graph.execute(_statement("of_classes"), values, binary=True).fetchall()
        det_pks = sorted({det_pk for _, det_pk in picked})
        values = {"det_pks": det_pks, **self._known.parameters}
        with _query_errors(self._targets.vector_url):
            rows = self._vectors.execute(_statement("described"), values, binary=True).fetchall()
        found, origin = self._near(rows)
        described = {row[2]: row[1:] for row in found}
        linked = self._follow(det_pks, origin)
        by_class: dict[str, list[int]] = {}
        for place, det_pk in picked:
            by_class.setdefault(names[place - 1], []).append(det_pk)
        near = [
            (number, *described[det_pk])
            for number in named
            for det_pk in by_class.get(crops[number].class_name or "", ())
            if det_pk in described
        ]
        return near, linked

    def _near(self, rows: _Rows) -> tuple[_Rows, str | None]:
        """Store the cosines; returns the rows that have an observation, from the column ``crop``
        on, and the origin."""
        cosines, origin = next((row[0] for row in rows if row[0] is not None), (None, None))
        self._known = self._known.with_cosines(cosines)
        return [row[1:_NEAR] for row in rows if row[3] is not None], origin

    def _follow(self, det_pks: Iterable[int], origin: str | None) -> "_Linked":
        """Object and Places of observations; ``origin`` is that of the vectors."""
        values = {"det_pks": sorted(set(det_pks)), "observation": LABEL_IDS["Observation"]}
        with _query_errors(self._targets.graph_url):
            values |= self._known.parameters
            rows = self._graph.execute(_statement("graph"), values, binary=True).fetchall()
            return self._linked(rows[0], origin)

    def _linked(self, row: tuple[Any, ...], origin: str | None) -> "_Linked":
        """Store the settings and check the origin; ``row`` has the columns of ``of_graph``."""
        settings, graph, maps, things, places = row[0]
        if graph != origin or settings is not None:
            place = describe_target(self._targets.graph_url)
            refuse_mixed(origin, graph, describe_target(self._targets.vector_url), place)
            self._known = self._known.with_settings(settings, place)
        if maps is not None:
            self._known = self._with_maps(maps[0])
        return _Linked.of(row[1:], things or {}, places or {})

    def _with_maps(self, key: str | None) -> KnownConstants:
        if key is None:
            return self._known.with_maps(None, {})
        with _query_errors(self._targets.graph_url):
            return self._known.with_maps(*read_with_key(self._graph))

    def _class_names(self) -> list[str]:
        with _query_errors(self._targets.graph_url):
            rows = self._graph.execute(_statement("class_names")).fetchall()
        return [json.loads(row[0]) for row in rows if row[0] is not None]


@lru_cache(maxsize=128)
def _statement(name: str, crops: int = 0, neighbours: int = 0) -> bytes:
    """The text of a statement. In those that search, ``crops`` is the number of crops and
    ``neighbours`` that of observations for each.

    Without comments and line breaks: psycopg reads a short statement once, a long one for every
    question.
    """
    rows = [
        sql.SQL("({}::int, {}::vector)").format(sql.Literal(i), sql.Placeholder(f"crop_{i}"))
        for i in range(crops)
    ]
    none = sql.SQL("SELECT 0, NULL::vector WHERE false")
    questions = sql.SQL("VALUES {}").format(sql.SQL(", ").join(rows)) if rows else none
    run = statements("relocalize")
    composed = run[name].format(
        questions=questions,
        neighbours=sql.Literal(neighbours),
        of_vectors=run["of_vectors"].format(cosines=run["cosines"]),
        of_graph=run["of_graph"].format(
            settings=run["settings"], maps=run["maps"], edges=run["edges"], **tables()
        ),
        observed=run["observed"],
        followed=run["followed"].format(**tables()),
        **tables(),
    )
    lines = [line.partition("--")[0].strip() for line in composed.as_string().splitlines()]
    return " ".join(line for line in lines if line).encode()


class _Thing(NamedTuple):
    object_id: str
    class_name: str
    estimate: ObjectEstimate | None


_NONE: Final = 0
"""Stands for no graph id; ids are never 0."""
_NO_EDGES: Final = (_NONE, _NONE, _NONE)


class _Linked(NamedTuple):
    """Ids of Object, its Place and the keyframe's Place by det_pk; and the Objects and Places with
    these ids."""

    ids: dict[int, tuple[int, int, int]]
    things: dict[int, _Thing]
    places: dict[int, tuple[PlaceOrdinal, CandidatePlace]]

    @classmethod
    def of(
        cls, edges: Sequence[list[int]], things: dict[str, str], places: dict[str, str]
    ) -> "_Linked":
        """Made from the edges in the statement ``graph`` and the properties of Objects and
        Places."""
        observes, located, has, in_place = (
            dict(zip(starts, ends, strict=True))
            for starts, ends in zip(edges[::2], edges[1::2], strict=True)
        )
        ids = {
            observation & _NUMBER_MASK: (
                thing := observes.get(observation, _NONE),
                located.get(thing, _NONE),
                in_place.get(has.get(observation, _NONE), _NONE),
            )
            for observation in observes.keys() | has.keys()
        }
        return cls(
            ids,
            {int(thing): _thing(properties) for thing, properties in things.items()},
            {
                int(place): (_ordinal(int(place)), _place(properties))
                for place, properties in places.items()
            },
        )

    def union(self, more: "_Linked") -> "_Linked":
        """The union with ``more``."""
        return _Linked(self.ids | more.ids, self.things | more.things, self.places | more.places)


_NOTHING: Final = _Linked({}, {}, {})


def _assemble(crops: int, near: _Rows, linked: _Linked, known: KnownConstants) -> MapCandidates:
    ordered = sorted(near, key=lambda row: (row[0], -row[1], row[2]))
    matches: list[list[Match]] = [[] for _ in range(crops)]
    ordinals = {place: ordinal for place, (ordinal, _) in linked.places.items()}
    for crop, similarity, det_pk, det_id, run_id, class_name, bbox, x, y, yaw, _ in ordered:
        thing_id, its, there = linked.ids.get(det_pk, _NO_EDGES)
        thing = linked.things.get(thing_id)
        matches[crop].append(
            Match(
                ObservationOrdinal(det_pk - 1),
                det_id,
                run_id,
                float(similarity),
                None if x is None else (x, y, yaw),
                _box(bbox),
                class_name if thing is None else thing.class_name,
                None if thing is None else thing.object_id,
                ordinals.get(its),
                ordinals.get(there),
                None if thing is None else thing.estimate,
            )
        )
    rows = tuple(map(tuple, matches))
    return MapCandidates(rows, dict(linked.places.values()), known.constants, known.walls)


def _box(array: str) -> Box:
    """A box from the text form of its array, which gives the log's numbers; the binary form would
    be rounded to 32 bits."""
    x0, y0, x1, y1 = array[1:-1].split(",")
    return float(x0), float(y0), float(x1), float(y1)


def _thing(properties: str) -> _Thing:
    """An Object; without an estimate under ``fusion = "page"`` and in a map of an older version,
    which has no covariance."""
    found = json.loads(properties)
    estimate = None
    if "est_xx" in found:
        estimate = ObjectEstimate(
            *(found[f"est_{name}"] for name in ("x", "y", "xx", "xy", "yy", "spots"))
        )
    return _Thing(found["object_id"], found["class_name"], estimate)


def _place(properties: str) -> CandidatePlace:
    found = json.loads(properties)
    return CandidatePlace(
        found["place_id"],
        found["centroid_x"],
        found["centroid_y"],
        found.get("name"),
        found.get("floor"),
    )


def _ordinal(graphid: int) -> PlaceOrdinal:
    return PlaceOrdinal((graphid & _NUMBER_MASK) - 1)


@contextlib.contextmanager
def _query_errors(url: str) -> Iterator[None]:
    """Translate errors of a question that does not fit the map, and of a database without a map."""
    with database_errors(url):
        try:
            yield
        except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
            raise ProjectionMissing(
                f"{describe_target(url)}: nothing has been projected there yet; run"
                f" `{advised('replay')}`"
            ) from None
        except psycopg.errors.DataException as error:
            raise QuestionError(
                f"the question does not fit the map: {error.diag.message_primary}; ask with the"
                " model that made the map"
            ) from None
