"""Compare the databases with the fold of the log, row by row; find foreign tables in the graph.

Each sink is compared at its own checkpoint, in one read-only snapshot, so that a tail may go on
writing. Both sides stream in the order of their ids and are merged: only the map itself is held in
memory. Properties are compared as values with their types, not as text: the server orders keys
and writes floats in its own way.

Foreign tables are labels, tables and rows without a label that another program has made in the
graph's schema: ``CREATE (n:Door)`` makes a label, which is a table; rows without a label are in the
tables that all labels inherit from. A rebuild replaces the graph and so drops them.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

import psycopg
from psycopg import IsolationLevel, sql

from eventsrc.envelope.grey_images import BadImage
from eventsrc.envelope.model import FIRST_OFFSET, Offset
from eventsrc.log import Event, LogReader
from projections.fold.map_errors import ProjectionMissing
from projections.fold.settings import Settings

from . import checkpoints, map_table
from .connection import (
    Connection,
    Targets,
    connect,
    database_errors,
    describe_target,
    pin_session_settings,
    statements,
)
from .cypher import PARENTS, refuse_without_age
from .graph_rows import Row, expected_rows
from .inputs import LogInputs, SettingsOf
from .labels import GRAPH, LABELS, MAP_TABLE, SINKS, TABLE, VERTEX_LABELS, SinkName
from .live_fold import LiveFold, batches
from .map_table import MapRow, map_of, map_rows
from .origin import command_for, refuse_mismatch, rows_dropped
from .sink import Checkpoint
from .vector_rows import VectorRow, new_rows

_RELATION_KINDS: Final = {"v": "VIEW", "m": "MATERIALIZED VIEW", "f": "FOREIGN TABLE"}


@dataclass(frozen=True, slots=True)
class ForeignTable:
    """A table in the graph's schema with rows that are not ours.

    ``rows`` is their number, None when this role may not read them. ``keep`` is SQL that copies
    them to the schema ``public``, ``remove`` is SQL that drops them.
    """

    table: str
    what: str
    rows: int | None
    keep: str
    remove: str


def foreign_tables(connection: Connection) -> tuple[ForeignTable, ...]:
    """The foreign tables of the graph's schema, by name."""
    values = {"graph": GRAPH, "ours": list(LABELS)}
    found = []
    for name, kind, label, readable in connection.execute(
        statements("foreign_tables")["tables"], values
    ).fetchall():
        rows = _count_rows(connection, name) if readable else None
        if name in PARENTS and not rows:
            continue
        found.append(_foreign_table(connection, name, kind, label, rows))
    return tuple(found)


def _count_rows(connection: Connection, name: str) -> int:
    query = sql.SQL("SELECT count(*) FROM ONLY {}").format(sql.Identifier(GRAPH, name))
    row = connection.execute(query).fetchone()
    return 0 if row is None else int(row[0])


def _foreign_table(
    connection: Connection, name: str, kind: str, label: str | None, rows: int | None
) -> ForeignTable:
    table, copy = sql.Identifier(GRAPH, name), sql.Identifier("public", name)
    if name in PARENTS:
        what = f"{'vertices' if name == PARENTS[0] else 'edges'} without a label"
        remove = sql.SQL("DELETE FROM ONLY {}").format(table)
    elif label is not None:
        what = f"{'vertex' if label == 'v' else 'edge'} label"
        call = sql.SQL("SELECT ag_catalog.drop_label({}, {})")
        remove = call.format(sql.Literal(GRAPH), sql.Literal(name))
    else:
        what = _RELATION_KINDS.get(kind, "TABLE").lower()
        remove = sql.SQL("DROP {} {}").format(sql.SQL(_RELATION_KINDS.get(kind, "TABLE")), table)
    # Not ALTER TABLE … SET SCHEMA: a label would stay a part of the graph.
    keep = sql.SQL("CREATE TABLE {} AS SELECT * FROM ONLY {}").format(copy, table)
    return ForeignTable(name, what, rows, keep.as_string(connection), remove.as_string(connection))


Kind: TypeAlias = Literal["missing", "extra", "different"]
Keyed: TypeAlias = tuple[int, Any]
"""A row's id, and its other values in a comparable form."""
NAMED: Final = 100
"""The most differences that are named; all are counted."""
STREAM_ROWS: Final = 2_000
BATCH_EVENTS: Final = 256
_VECTORS: Final = """
SELECT det_pk, run_id, det_id, keyframe_id, class_name, confidence, bbox, map_x, map_y, map_yaw,
       camera, embedding_model, embedding::real[],
       (extract(epoch FROM ingested_at) * 1000000)::bigint
FROM public.detection_embeddings ORDER BY det_pk
"""


@dataclass(frozen=True, slots=True)
class RowDifference:
    """A row that is missing, extra or different; ``id`` is its graphid or det_pk."""

    table: str
    id: int
    kind: Kind
    expected: str | None
    found: str | None


@dataclass(frozen=True, slots=True)
class CheckReport:
    """One sink at its checkpoint. ``differences`` are the first of ``differing``.

    ``foreign`` are the tables in the graph's schema that a rebuild would drop. The corrections are
    those of the commands before ``known_at``.
    """

    sink: SinkName
    next_offset: Offset
    rows: int
    differing: int
    differences: tuple[RowDifference, ...]
    foreign: tuple[ForeignTable, ...] = ()
    known_at: Offset | None = None

    @property
    def sound(self) -> bool:
        """True when the sink has exactly the rows of the fold, and no foreign table."""
        return not self.differing and not self.foreign


def check(
    log: Path,
    targets: Targets,
    settings: Settings | SettingsOf,
    *,
    only: SinkName | None = None,
) -> list[CheckReport]:
    """Compare the sinks with the fold, each under the corrections of its checkpoint.

    Raises ProjectionMissing and ProjectionMismatch.
    """
    sinks: tuple[tuple[SinkName, str], ...] = (
        ("graph", targets.graph_url),
        ("vectors", targets.vector_url),
    )
    return [_check_sink(log, sink, url, settings) for sink, url in sinks if only in (None, sink)]


def _check_sink(
    log: Path, sink: SinkName, url: str, settings: Settings | SettingsOf
) -> CheckReport:
    comparison = _Comparison()
    with LogReader(log) as reader, connect(url, application="mapfold check") as connection:
        connection.isolation_level = IsolationLevel.REPEATABLE_READ
        connection.read_only = True
        with database_errors(url):
            pin_session_settings(connection)
            if sink == "graph":
                refuse_without_age(connection)
            connection.commit()
            locked = _lock_tables(connection, sink)
            checkpoint = checkpoints.load(connection, sink)
            reader.refresh()  # a tail may have moved the checkpoint since it was opened
            known = LogInputs.read(reader, settings)
            if checkpoint is None:
                has = "have" if SINKS[sink].is_plural else "has"
                raise ProjectionMissing(
                    f"{describe_target(url)}: no {sink} {has} been projected there; run:"
                    f" {command_for('replay', log, known.latest)}"
                )
            if not locked:
                raise rows_dropped(checkpoint, sink, describe_target(url), log, known.latest)
            inputs = known.at(checkpoint.known_at)
            refuse_mismatch(checkpoint, sink, describe_target(url), log, reader, inputs)
            fold = LiveFold(inputs.settings, corrections=inputs.corrections, reader=reader)
            folding = _folded(fold, _events(connection, reader, checkpoint, sink))
            compare = _compare_graph if sink == "graph" else _compare_vectors
            compare(connection, fold, folding, comparison)
            foreign = foreign_tables(connection) if sink == "graph" else ()
    return CheckReport(
        sink,
        checkpoint.next_offset,
        comparison.rows,
        comparison.differing,
        tuple(comparison.differences),
        foreign,
        checkpoint.known_at,
    )


def _lock_tables(connection: Connection, sink: SinkName) -> bool:
    """Lock a sink's tables against swaps until the transaction ends; False when there are none.

    It must be the transaction's first statement: a snapshot from before a swap sees the new tables
    as empty.
    """
    tables = sql.SQL(", ").join(sql.Identifier(*table) for table in SINKS[sink].tables)
    try:
        connection.execute(sql.SQL("LOCK TABLE {} IN ACCESS SHARE MODE").format(tables))
    except (psycopg.errors.UndefinedTable, psycopg.errors.InvalidSchemaName):
        connection.rollback()
        return False
    return True


class _Comparison:
    """Merges pairs of streams ordered by id; counts rows and keeps differences."""

    def __init__(self) -> None:
        self.rows = 0
        self.differing = 0
        self.differences: list[RowDifference] = []

    def merge(self, table: str, expected: Iterator[Keyed], found: Iterator[Keyed]) -> None:
        want, have = next(expected, None), next(found, None)
        while want is not None or have is not None:
            self.rows += 1
            if have is None or (want is not None and want[0] < have[0]):
                self._add_difference(table, "missing", want, None)
                want = next(expected, None)
            elif want is None or have[0] < want[0]:
                self._add_difference(table, "extra", None, have)
                have = next(found, None)
            else:
                if want[1] != have[1]:
                    self._add_difference(table, "different", want, have)
                want, have = next(expected, None), next(found, None)

    def _add_difference(
        self, table: str, kind: Kind, want: Keyed | None, have: Keyed | None
    ) -> None:
        self.differing += 1
        row = want or have
        if row is not None and len(self.differences) < NAMED:
            expected, found = (None if r is None else _shortened(r[1]) for r in (want, have))
            self.differences.append(RowDifference(table, row[0], kind, expected, found))


def _events(
    connection: Connection, reader: LogReader, checkpoint: Checkpoint, sink: SinkName
) -> Iterator[tuple[Event, bool]]:
    """The events up to the checkpoint, and whether each was parked."""
    parked = {letter.offset for letter in checkpoints.parked(connection, sink)}
    for event in reader.read(FIRST_OFFSET, checkpoint.next_offset):
        yield event, event.offset in parked


def _compare_graph(
    connection: Connection, fold: LiveFold, folding: Iterator[None], comparison: _Comparison
) -> None:
    for _ in folding:
        fold.tracker.drain()
    for label in LABELS:
        columns = ["id"] if label in VERTEX_LABELS else ["id", "start_id", "end_id"]
        ids = sql.SQL(", ").join(sql.SQL("{}::text").format(sql.Identifier(c)) for c in columns)
        query = sql.SQL("SELECT {}, properties FROM {} ORDER BY {}.id USING OPERATOR(ag_catalog.<)")
        table = sql.Identifier(GRAPH, label)
        with connection.cursor(name="check") as cursor:
            cursor.itersize = STREAM_ROWS
            cursor.execute(query.format(ids, table, sql.Identifier(label)))
            expected = (_graph_row(row) for row in expected_rows(fold.view, label))
            comparison.merge(label, expected, (_graph_row(row) for row in cursor))
    maps = map_rows(fold.view), map_table.read(connection)
    comparison.merge(MAP_TABLE, *(map(_map_row, rows) for rows in maps))


def _compare_vectors(
    connection: Connection, fold: LiveFold, folding: Iterator[None], comparison: _Comparison
) -> None:
    expected = (
        _vector_row(row) for _ in folding for row in new_rows(fold.tracker.drain(), fold.view)
    )
    # Binary, so that a float32 arrives as the float32 it is.
    with connection.cursor(name="check", binary=True) as cursor:
        cursor.itersize = STREAM_ROWS
        cursor.execute(_VECTORS)
        comparison.merge(TABLE, expected, ((row[0], row[1:]) for row in cursor))


def _folded(fold: LiveFold, events: Iterable[tuple[Event, bool]]) -> Iterator[None]:
    """Fold the events; yields after each batch."""
    for parked, group in groupby(events, key=itemgetter(1)):
        for batch in batches((event for event, _ in group), BATCH_EVENTS):
            if parked:
                for event in batch:
                    fold.skip(event.offset)
                continue
            for failed in fold.feed(batch):
                if failed is not None:
                    raise failed
            yield


def _graph_row(row: Row | tuple[Any, ...]) -> Keyed:
    *ends, properties = row
    # Floats as marked text, so that 1.0 is not 1 and -0.0 is not 0.0.
    values = json.loads(properties, parse_float=lambda text: f"float {float(text)!r}", strict=False)
    return int(ends[0]), (tuple(map(int, ends[1:])), values)


def _vector_row(row: VectorRow) -> Keyed:
    pose, added = row.pose or (None, None, None), row.added
    return row.det_pk, (
        added.run_id, added.det_id, added.keyframe_id, added.class_name, added.confidence,
        list(row.bbox), *pose, None if row.camera is None else list(row.camera),
        added.embedding_model, row.embedding.tolist(), row.ingested_us,
    )  # fmt: skip


def _map_row(row: MapRow) -> Keyed:
    """With the digest of the image instead of its bytes: zlib's versions pack them differently."""
    try:
        image = map_of(row).digest()
    except BadImage as error:
        image = f"png: {error}"
    return row.log_offset, (*row[1:-2], row.digest, image)


def _shortened(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 300 else text[:297] + "..."
