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
from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, Self

import numpy as np
import psycopg
from pgvector.psycopg import register_vector
from psycopg import sql

from eventsrc.base.text import advised
from projections.fold.map_errors import (
    DatabaseError,
    ExtensionMissing,
    ProjectionMismatch,
    QuestionError,
)
from projections.fold.settings import CameraConstants
from projections.localize.relocalize import (
    NEIGHBOURS,
    Answer,
    MapCandidates,
    Method,
    Question,
    QuestionCrop,
    rank,
)
from projections.localize.relocalize.candidates import (
    OBSERVATIONS_OF_EACH,
    check_space,
    objects_of_a_class,
    refuse_unknown_classes,
)
from projections.map.naming import ShortIds
from projections.postgres.connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_connection,
    describe_target,
    statements,
    tables,
)
from projections.postgres.cypher import refuse_without_age
from projections.postgres.graph_rows import text
from projections.postgres.labels import LABEL_IDS
from projections.postgres.map_table import read_with_key

from .candidate_rows import (
    NO_LINKS,
    ConstantsMemory,
    KnownConstants,
    Linked,
    Rows,
    assemble,
    bare_row,
)
from .graph_reads import map_errors, read_short_ids

_NEAR: Final = 13
"""Number of columns of the statement ``near``."""


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
        self, targets: Targets, vectors: Connection, graph: Connection, memory: ConstantsMemory
    ) -> None:
        self._targets, self._memory = targets, memory
        self._vectors, self._graph = vectors, graph
        self._known: KnownConstants = memory.known

    def candidates(
        self, crops: Sequence[QuestionCrop], neighbours: int = NEIGHBOURS
    ) -> MapCandidates:
        """The ``neighbours`` observations most similar to each crop, with their Places; of a crop
        without embedding, and of every one in a map without, observations of its class."""
        looked = [number for number, crop in enumerate(crops) if crop.vector is not None]
        named = [number for number, crop in enumerate(crops) if crop.vector is None]
        near: Rows = []
        linked, given = NO_LINKS, crops
        if looked or not named:
            near, linked = self._nearest([crops[number] for number in looked], neighbours)
            if looked and not near:
                crops = [crop.by_class() for crop in crops]
                named = [number for number, crop in enumerate(crops) if crop.vector is None]
            elif named:
                near = [(looked[crop], *row) for crop, *row in near]
        if named:
            of_classes, more = self._of_classes(crops, named)
            near, linked = near + of_classes, linked.union(more)
        self._memory.known = self._known
        found = assemble(len(crops), near, linked, self._known)
        refuse_unknown_classes(given, found.matches, self._class_names)
        return replace(found, by_class=crops is not given and any(found.matches))

    def try_question(self) -> None:
        """Ask a question of one observation that is stored, if there is one. Raises DatabaseError
        when questions cannot be answered."""
        with _query_errors(self._targets.vector_url):
            row = self._vectors.execute(
                "SELECT embedding::real[] FROM public.detection_embeddings LIMIT 1", binary=True
            ).fetchone()
        if row is not None:
            self.candidates([QuestionCrop(np.array(row[0], np.float32))])

    def _nearest(self, crops: Sequence[QuestionCrop], neighbours: int) -> tuple[Rows, Linked]:
        """Rows of crop, similarity, det_pk and further columns of ``near``; and their Objects and
        Places."""
        one = self._vectors is self._graph
        values: dict[str, Any] = {"observation": LABEL_IDS["Observation"]}
        values |= {f"crop_{i}": crop.vector for i, crop in enumerate(crops)}
        with _query_errors(self._targets.vector_url):
            size = max((len(crop.vector) for crop in crops if crop.vector is not None), default=1)
            searching = ("near_and_graph" if one else "near", len(crops), neighbours, size)
            values |= self._known.parameters
            rows = self._vectors.execute(_statement(*searching), values, binary=True).fetchall()
        near, origin = self._near(rows)
        model = next((row[-1] for row in near), None)
        for crop in crops:
            check_space(crop, 0 if crop.vector is None else len(crop.vector), model)
        if not one:
            return near, self._follow([row[2] for row in near], origin)
        of_graph = next((row[_NEAR:] for row in rows if row[_NEAR] is not None), None)
        return near, NO_LINKS if of_graph is None else self._linked(of_graph, origin)

    def _of_classes(
        self, crops: Sequence[QuestionCrop], named: Sequence[int]
    ) -> tuple[Rows, Linked]:
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
        described |= self._bare([det_pk for det_pk in det_pks if det_pk not in described])
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

    def _bare(self, det_pks: list[int]) -> dict[int, tuple[Any, ...]]:
        """The columns of `described` but the first, of observations without an embedding."""
        if not det_pks:
            return {}
        values = {"det_pks": det_pks, "observation": LABEL_IDS["Observation"]}
        values |= {"pose": LABEL_IDS["Pose"]}
        with _query_errors(self._targets.graph_url):
            rows = self._graph.execute(_statement("bare"), values).fetchall()
        return {det_pk: bare_row(det_pk, *properties) for det_pk, *properties in rows}

    def _near(self, rows: Rows) -> tuple[Rows, str | None]:
        """Store the cosines; returns the rows that have an observation, from the column ``crop``
        on, and the origin."""
        cosines, origin = next((row[0] for row in rows if row[0] is not None), (None, None))
        self._known = self._known.with_cosines(cosines)
        return [row[1:_NEAR] for row in rows if row[3] is not None], origin

    def _follow(self, det_pks: Iterable[int], origin: str | None) -> Linked:
        """Object and Places of observations; ``origin`` is that of the vectors."""
        values = {"det_pks": sorted(set(det_pks)), "observation": LABEL_IDS["Observation"]}
        with _query_errors(self._targets.graph_url):
            values |= self._known.parameters
            rows = self._graph.execute(_statement("graph"), values, binary=True).fetchall()
            return self._linked(rows[0], origin)

    def _linked(self, row: tuple[Any, ...], origin: str | None) -> Linked:
        """Store the settings and check the origin; ``row`` has the columns of ``of_graph``."""
        settings, graph, maps, things, places = row[0]
        if graph != origin or settings is not None:
            place = describe_target(self._targets.graph_url)
            refuse_mixed(origin, graph, describe_target(self._targets.vector_url), place)
            self._known = self._known.with_settings(settings, place)
        if maps is not None:
            self._known = self._with_maps(maps[0])
        return Linked.of(row[1:], things or {}, places or {})

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
def _statement(name: str, crops: int = 0, neighbours: int = 0, dimension: int = 1) -> bytes:
    """The text of a statement, without comments and line breaks, as psycopg parses long texts again
    for each question. Those that search are for so many ``crops``, all of one ``dimension``, and
    find ``neighbours`` observations for each."""
    rows = [
        sql.SQL("({}::int, {}::vector)").format(sql.Literal(i), sql.Placeholder(f"crop_{i}"))
        for i in range(crops)
    ]
    none = sql.SQL("SELECT 0, NULL::vector WHERE false")
    questions = sql.SQL("VALUES {}").format(sql.SQL(", ").join(rows)) if rows else none
    run = statements("relocalize")
    composed = run[name].format(
        questions=questions,
        nearest=run["nearest"].format(
            indexed=run["indexed"],
            dimension=sql.Literal(dimension),
            candidates=sql.Literal(max(_CANDIDATES, neighbours)),
            neighbours=sql.Literal(neighbours),
        ),
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


@contextlib.contextmanager
def _query_errors(url: str) -> Iterator[None]:
    """As `map_errors`, and raises QuestionError for a question that does not fit the map,
    ProjectionMismatch for a map of an older version."""
    with map_errors(url):
        try:
            yield
        except psycopg.errors.UndefinedColumn as error:
            raise ProjectionMismatch(
                f"{describe_target(url)}: an older mapfold made the map there"
                f" ({error.diag.message_primary}); run `{advised('replay')}`, which makes it again"
            ) from None
        except psycopg.errors.DataException as error:
            raise QuestionError(
                f"the question does not fit the map: {error.diag.message_primary}; ask with the"
                " model that made the map"
            ) from None


_CANDIDATES = max(200, NEIGHBOURS)
"""From the index, compared by whole vectors: at 300,000 observations 0.991 of the ten nearest."""


def relocalize(
    targets: Targets,
    question: Question | Sequence[QuestionCrop],
    *,
    top: int = 3,
    method: Method = "joint",
    camera: CameraConstants | None = None,
) -> Answer:
    """Answer a question for re-localisation from the databases as they are now."""
    crops = question.crops if isinstance(question, Question) else question
    with CandidateReader(targets) as reader:
        return rank(question, reader.candidates(crops), top=top, method=method, camera=camera)


def question_error(targets: Targets) -> str | None:
    """Why questions cannot be answered, found by asking one; None if they can."""
    try:
        with CandidateReader(targets) as reader:
            reader.try_question()
    except DatabaseError as error:
        return str(error)
    return None


def prepare_graph(connection: Connection) -> None:
    """Set up a session for joins of the graph's tables by id; ag_catalog comes last in the path.

    Raises ExtensionMissing for a user who may not use AGE.

    A question joins a few hundred ids. By default the planner reads whole tables into hashes for
    that: 300 ms instead of 10 at 300,000 observations.
    """
    refuse_without_age(connection)
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
            f" the extension vector is created; run `{advised('replay')}`"
        ) from None
    connection.execute("SELECT '[1]'::vector")  # loads the library, whose settings come next
    connection.execute("SET jit = off")  # compiling the exact search takes longer than the other
    connection.execute(sql.SQL("SET hnsw.ef_search = {}").format(sql.Literal(_CANDIDATES)))


class CandidateReader:
    """Connections to the databases of one projection, for one question after the other."""

    def __init__(self, targets: Targets, memory: ConstantsMemory | None = None) -> None:
        self._targets, self._memory = targets, memory or ConstantsMemory()
        self._vectors = connect(targets.vector_url, application="mapfold ask", autocommit=True)
        self._graph = self._vectors
        try:
            with database_errors(targets.vector_url):
                prepare_vectors(self._vectors)
            if not targets.one_database:
                self._graph = connect(targets.graph_url, application="mapfold ask", autocommit=True)
            with database_errors(targets.graph_url):
                prepare_graph(self._graph)
        except BaseException:
            self.close()
            raise

    def candidates(
        self, crops: Sequence[QuestionCrop], neighbours: int = NEIGHBOURS
    ) -> MapCandidates:
        """The ``neighbours`` observations most similar to each crop, with their Places."""
        return self._search().candidates(crops, neighbours)

    def try_question(self) -> None:
        """Ask one question. Raises DatabaseError when questions cannot be answered."""
        self._search().try_question()

    def short_ids(self) -> ShortIds:
        """The short ids of the map."""
        return read_short_ids(self._graph)

    def _search(self) -> CandidateSearch:
        return CandidateSearch(self._targets, self._vectors, self._graph, self._memory)

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
