"""Re-localisation with the live databases.

`relocalize` answers a whole question; a `CandidateReader` keeps the connections for several. The
candidates (`projections.postgres.queries.candidates`) are ranked in
`projections.localize.relocalize`.
"""

from collections.abc import Sequence
from typing import Self

import psycopg
from pgvector.psycopg import register_vector
from psycopg import sql

from eventsrc.base.advised import advised
from projections.fold.errors import DatabaseError, ExtensionMissing
from projections.fold.settings import Camera
from projections.localize.relocalize import (
    NEIGHBOURS,
    Answer,
    MapCandidates,
    Method,
    Question,
    QuestionCrop,
    rank,
)
from projections.postgres.connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_connection,
)
from projections.postgres.cypher import refuse_without_age

from .candidates import CandidateSearch
from .known_constants import ConstantsMemory

_EF_SEARCH = max(100, NEIGHBOURS)


def relocalize(
    targets: Targets,
    question: Question | Sequence[QuestionCrop],
    *,
    top: int = 3,
    method: Method = "joint",
    camera: Camera | None = None,
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
    connection.execute(sql.SQL("SET hnsw.ef_search = {}").format(sql.Literal(_EF_SEARCH)))


class CandidateReader:
    """Connections to the databases of one projection, for one question after the other."""

    def __init__(self, targets: Targets, memory: ConstantsMemory | None = None) -> None:
        self._targets, self._memory = targets, memory or ConstantsMemory()
        self._vectors = connect(targets.vector_url, application="mapfold query", autocommit=True)
        self._graph = self._vectors
        try:
            with database_errors(targets.vector_url):
                prepare_vectors(self._vectors)
            if not targets.one_database:
                self._graph = connect(
                    targets.graph_url, application="mapfold query", autocommit=True
                )
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

    def _search(self) -> CandidateSearch:
        return CandidateSearch(self._targets, self._vectors, self._graph, self._memory)

    def disable_index(self) -> None:
        """From now on search exactly, without the HNSW index: slow."""
        self._vectors.execute("SET enable_indexscan = off")
        # plans made before would still use the index
        self._vectors.execute("SET plan_cache_mode = force_custom_plan")

    def close(self) -> None:
        """Close the connections. May be called twice."""
        self._vectors.close()
        self._graph.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
