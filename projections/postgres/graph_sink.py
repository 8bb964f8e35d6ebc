"""The sink that writes the map as an Apache AGE graph, and its tables.

AGE keeps a graph as a schema, so a graph is *ours* when the schema carries our mark as its comment.
Anything else under these names belongs to another program: it is refused and never changed, except
that an empty graph, as scripts that set up a database make it, is taken over (`_adopt_if_empty`).

The swap renames the old graph; it is dropped later, when every transaction that may still have
looked up its name has ended (see `replaced_tables`).
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from itertools import count
from typing import Final

from psycopg import sql

from projections.fold.map_errors import DatabaseError
from projections.map.changes import BatchChanges
from projections.map.view import MapView

from . import labels, map_table, replaced_tables
from .connection import Connection, describe_connection, ensure_extension, statements
from .cypher import PARENTS, add_policies, policies_apply
from .graph_rows import GraphRows, Row, changed_rows, changing_rows, fixed_rows
from .loader import Load, copy_to_graph, graph_statement, insert_into_graph, unnest_columns
from .map_table import MapRow, map_rows
from .replaced_tables import (
    copy_privileges,
    try_drop_lock,
    wait_for_drop,
    wait_for_earlier_transactions,
)
from .sink import PreparedWrite

EARLY: Final[frozenset[labels.Label]] = frozenset({"Observation"})
"""Labels that a rebuild indexes before it writes them. That costs the server more than indexing
afterwards, but the server has the time while the fold goes on."""
LATE: Final = frozenset(labels.LABELS) - EARLY
SMALL_BATCH: Final = 200
"""Below this many rows an INSERT, sent down the pipeline, beats COPY's extra round trips."""
_MARK: Final = "mapfold"


class GraphSink:
    """Implements `Sink` for the graph ``semantic_map``."""

    name: Final[labels.SinkName] = "graph"

    def ensure(self, connection: Connection) -> bool:
        """Create an empty graph if there is none, or one without labels."""
        ensure_extension(connection, "age")
        _adopt_if_empty(connection, labels.GRAPH)
        if not graph_exists(connection, labels.GRAPH):
            create_graph(connection, labels.GRAPH)
        elif _is_bare(connection, labels.GRAPH):
            _add_labels(connection, labels.GRAPH)
        else:
            map_table.refuse_missing(connection)
            return False
        index_graph(connection, labels.GRAPH)
        map_table.ensure(connection)
        map_table.replace(connection, [])
        return True

    def prepare(self, changes: BatchChanges, view: MapView) -> PreparedWrite[Connection]:
        """Rows that a batch changed."""
        rows = changed_rows(changes, view)
        maps = map_rows(view) if changes.maps else None
        is_small = maps is None and sum(map(len, rows.inserted.values())) < SMALL_BATCH
        return PreparedWrite(partial(self._write, rows, maps, is_small), is_small)

    def _write(
        self,
        rows: GraphRows,
        maps: list[MapRow] | None,
        is_small: bool,
        connection: Connection,
    ) -> None:
        copies = not is_small and not policies_apply(connection)
        load_of = copy_to_graph if copies else insert_into_graph
        for label, inserted in rows.inserted.items():
            load_of(labels.GRAPH, label, inserted)(connection)
        for label, upserted in rows.upserted.items():
            kind = "upsert_vertex" if label in labels.VERTEX_LABELS else "upsert_edge"
            unnest_columns(kind, labels.GRAPH, label, upserted)(connection)
        for label, replaced in rows.replaced.items():
            _delete(connection, label, [int(row[1]) for row in replaced], "delete_from")
            insert_into_graph(labels.GRAPH, label, replaced)(connection)
        for label, ids in rows.deleted.items():
            _delete(connection, label, ids)
        if maps is not None:
            map_table.replace(connection, maps)

    def drop_leftovers(self, connection: Connection) -> None:
        """Drop a replaced graph that a reader held on to; refuse a graph that is not ours, unless
        it is empty.

        Not inside the rebuild's transaction: AGE 1.5 crashes the session that drops a graph after
        it has made another one in the same transaction.
        """
        ensure_extension(connection, "age")
        with connection.transaction():
            _adopt_if_empty(connection, labels.GRAPH)
            graph_exists(connection, labels.GRAPH)
        if try_drop_lock(connection, self.name):
            for graph in (labels.OLD_GRAPH, labels.NEXT_GRAPH):
                with connection.transaction():
                    drop_graph(connection, graph)

    def shadow(self) -> "GraphShadow":
        """A shadow, not created yet."""
        return GraphShadow()

    def drop_replaced(self, connection: Connection) -> None:
        """Drop the replaced graph once its last reader has ended."""
        if wait_for_earlier_transactions(connection) and try_drop_lock(connection, self.name):
            _drop_in_background(connection, labels.OLD_GRAPH)


class GraphShadow:
    """Implements `Shadow`: the graph ``semantic_map_next``."""

    def create(self, connection: Connection) -> None:
        """Create an empty graph and its early indexes."""
        create_graph(connection, labels.NEXT_GRAPH)
        index_graph(connection, labels.NEXT_GRAPH, EARLY)

    def load(self, changes: BatchChanges, view: MapView) -> Load:
        """Returns a function that writes the fixed rows of new keyframes and observations."""
        return self._load(fixed_rows(view, changes))

    def finish(self, view: MapView) -> Callable[[Connection], Mapping[str, int]]:
        """Returns a function that writes the changing rows, builds the other indexes and compares
        numbers by label."""
        load, maps, counts = self._load(changing_rows(view)), map_rows(view), view.counts()
        expected = {label: counts[labels.COUNT_KEYS[label]] for label in labels.LABELS}

        def finish(connection: Connection) -> Mapping[str, int]:
            load(connection)
            map_table.ensure(connection)
            map_table.replace(connection, maps)
            index_graph(connection, labels.NEXT_GRAPH, LATE)
            analyze_graph(connection, labels.NEXT_GRAPH)
            found = _compared(connection, expected)
            return {**found, labels.MAP_TABLE: len(maps)} if maps else found

        return finish

    def lock_readers(self, connection: Connection) -> None:
        """Keep readers away from the graph."""
        wait_for_drop(connection, GraphSink.name)
        _lock(connection, labels.GRAPH)

    def swap_in(self, connection: Connection) -> None:
        """Put the shadow in the readers' place, open to the same roles."""
        copy_privileges(connection, labels.GRAPH, labels.NEXT_GRAPH)
        _swap_in(connection, labels.NEXT_GRAPH)

    def _load(self, rows_of: Mapping[labels.Label, list[Row]]) -> Load:
        loads = [copy_to_graph(labels.NEXT_GRAPH, label, rows) for label, rows in rows_of.items()]

        def load(connection: Connection) -> None:
            for send in loads:
                send(connection)

        return load


def _delete(
    connection: Connection, label: labels.Label, ids: Sequence[int], statement: str = "delete"
) -> None:
    connection.execute(graph_statement(statement, labels.GRAPH, label), [[str(i) for i in ids]])


def _compared(connection: Connection, expected: Mapping[labels.Label, int]) -> Mapping[str, int]:
    """Rows by label. Raises DatabaseError where they are not as many as expected."""
    found = count_graph(connection, labels.NEXT_GRAPH)
    wrong = [
        f"{label}: {found[label]} rows, {expected[label]} in the map"
        for label in labels.LABELS
        if found[label] != expected[label]
    ]
    if wrong:
        raise DatabaseError(
            f"{describe_connection(connection)}: the rebuilt graph does not match the map"
            f" ({'; '.join(wrong)}); the old one stays, please report this"
        )
    return found


def graph_exists(connection: Connection, graph: str) -> bool:
    """Whether a graph of ours has this name. Raises DatabaseError when it is not ours."""
    row = connection.execute(statements("graph")["state"], {"graph": graph}).fetchone()
    if row is None:
        return False
    if not row[0] or not str(row[1]).startswith(_MARK):
        renaming = _renaming(connection, graph, is_graph=row[0])
        raise DatabaseError(
            f"{describe_connection(connection)}: has a {'graph' if row[0] else 'schema'} {graph}"
            f" that mapfold did not make; rename it by `{renaming}`, or use another database"
        )
    return True


def _renaming(connection: Connection, graph: str, *, is_graph: bool) -> str:
    """The SQL statement that renames a graph or a schema to an unused name."""
    rows = connection.execute(statements("graph")["taken_names"], {"pattern": f"{graph}%"})
    taken = {name for (name,) in rows}
    names = (f"{graph}_{number}" for number in count(1))
    free = next(name for name in names if name not in taken)
    if is_graph:
        return f"SELECT ag_catalog.alter_graph('{graph}', 'RENAME', '{free}');"
    return f"ALTER SCHEMA {graph} RENAME TO {free};"


def _adopt_if_empty(connection: Connection, graph: str) -> None:
    """Take over a graph that another program made and that has no vertex, edge or other table.
    Inside a transaction. The rights on its schema stay, unless it has labels: then another one
    takes its place, because labels get their numbers in the order in which they are made. It is
    renamed and dropped with the next replay: AGE 1.5 may end a session that drops a graph."""
    run = statements("graph")
    row = connection.execute(run["state"], {"graph": graph}).fetchone()
    if row is None or not row[0] or row[1] or not _is_empty(connection, graph):
        return
    if not _is_bare(connection, graph) and graph_exists(connection, labels.OLD_GRAPH):
        return  # its place is taken until the next replay
    parents = sql.SQL(", ").join(sql.Identifier(graph, parent) for parent in PARENTS)
    connection.execute(run["lock"].format(tables=parents))
    if not _is_empty(connection, graph):  # written to meanwhile
        return
    _use_age(connection)
    connection.execute(run["mark"].format(graph=sql.Identifier(graph)))
    if not _is_bare(connection, graph):
        drop_later = {"graph": graph, "new_name": labels.OLD_GRAPH}
        connection.execute(run["rename_graph"], drop_later)
        connection.execute(run["create_graph"], {"graph": graph})
        connection.execute(run["mark"].format(graph=sql.Identifier(graph)))


def _is_empty(connection: Connection, graph: str) -> bool:
    vertices, edges = (sql.Identifier(graph, parent) for parent in PARENTS)
    query = statements("graph")["is_empty"].format(vertices=vertices, edges=edges)
    row = connection.execute(query, {"graph": graph}).fetchone()
    return row is not None and bool(row[0])


def _is_bare(connection: Connection, graph: str) -> bool:
    """Whether a graph has no labels but those that every graph has."""
    return set(_label_ids(connection, graph)) <= set(PARENTS)


def create_graph(connection: Connection, graph: str) -> None:
    """An empty graph with all labels."""
    _use_age(connection)
    run = statements("graph")
    connection.execute(run["create_graph"], {"graph": graph})
    connection.execute(run["mark"].format(graph=sql.Identifier(graph)))
    _add_labels(connection, graph)


def _add_labels(connection: Connection, graph: str) -> None:
    """All labels of a graph that has none, in the order that gives them their constant ids."""
    _use_age(connection)
    run = statements("graph")
    for label in labels.LABELS:
        kind = "create_vlabel" if label in labels.VERTEX_LABELS else "create_elabel"
        connection.execute(run[kind], {"graph": graph, "label": label})
    for name in labels.LABELS:
        table = sql.Identifier(graph, name)
        connection.execute(run["no_statistics"].format(table=table))
    add_policies(connection, graph)
    found = _label_ids(connection, graph)
    if any(found.get(label) != number for label, number in labels.LABEL_IDS.items()):
        raise DatabaseError(
            f"{describe_connection(connection)}: this version of Apache AGE numbers labels in"
            f" another way ({found}); use AGE 1.5 to 1.8"
        )


def _label_ids(connection: Connection, graph: str) -> dict[str, int]:
    rows = connection.execute(statements("graph")["label_ids"], {"graph": graph}).fetchall()
    return dict(rows)


def index_graph(
    connection: Connection, graph: str, of: Collection[labels.Label] = frozenset(labels.LABELS)
) -> None:
    """Create the indexes for queries and upserts that AGE has not made itself."""
    rows = connection.execute(statements("graph")["indexed"], {"graph": graph}).fetchall()
    unique = {(table, column): is_unique for table, column, is_unique in rows}

    def make(kind: str, label: labels.Label, **parts: sql.Composable) -> None:
        connection.execute(graph_statement(kind, graph, label, **parts))

    for label in filter(of.__contains__, labels.LABELS):
        if (label in labels.VERTEX_LABELS or label in labels.CHANGING_EDGES) and not unique.get(
            (label, "id")
        ):
            make("index_unique", label, column=sql.Identifier("id"))
        for end in ("start_id", "end_id") if label in labels.EDGE_LABELS else ():
            if (label, end) not in unique:
                make("index", label, column=sql.Identifier(end))
        if label in labels.KEYS:
            make("index_key", label, key=sql.Literal(f'"{labels.KEYS[label]}"'))
        if label in labels.MATCHED:
            make("index_match", label)


def count_graph(connection: Connection, graph: str) -> dict[str, int]:
    """Rows by label."""
    select = sql.SQL("SELECT {}, count(*) FROM {}")
    selects = [
        select.format(sql.Literal(each), sql.Identifier(graph, each)) for each in labels.LABELS
    ]
    return dict(connection.execute(sql.SQL(" UNION ALL ").join(selects)).fetchall())


def _lock(connection: Connection, graph: str) -> None:
    """Lock all tables of a graph exclusively, if it is there; another version's may have fewer."""
    if graph_exists(connection, graph):
        there = _label_ids(connection, graph)
        names = [*PARENTS, *filter(there.__contains__, labels.LABELS)]
        tables = sql.SQL(", ").join(sql.Identifier(graph, name) for name in names)
        connection.execute(statements("graph")["lock"].format(tables=tables))


def _swap_in(connection: Connection, shadow: str) -> None:
    """Rename the readers' graph to `OLD_GRAPH` and ``shadow`` to the readers' name."""
    _use_age(connection)
    run = statements("graph")
    if graph_exists(connection, labels.GRAPH):
        connection.execute(
            run["rename_graph"], {"graph": labels.GRAPH, "new_name": labels.OLD_GRAPH}
        )
    connection.execute(run["rename_graph"], {"graph": shadow, "new_name": labels.GRAPH})


def drop_graph(connection: Connection, graph: str) -> None:
    """Drop a graph of ours, if it is there."""
    if graph_exists(connection, graph):
        _use_age(connection)
        with connection.cursor() as cursor:
            cursor.execute("SET LOCAL client_min_messages = warning")
            cursor.execute(statements("graph")["drop_graph"], {"graph": graph})


def _drop_in_background(connection: Connection, graph: str) -> None:
    """Have the server drop a graph of ours, if it is there; closes the connection then."""
    if graph_exists(connection, graph):
        connection.execute("SET search_path = ag_catalog, public")
        replaced_tables.send_and_close(
            connection, statements("graph")["drop_named"].format(graph=sql.Literal(graph))
        )


def analyze_graph(connection: Connection, graph: str) -> None:
    """Gather statistics, so that the planner knows which labels are large.

    Inside a transaction. The keys that readers look up are nearly unique, which a small sample
    shows.
    """
    connection.execute(statements("graph")["sample"])
    for label in labels.LABELS:
        connection.execute(graph_statement("analyze", graph, label))


def _use_age(connection: Connection) -> None:
    """AGE's own functions find their operator classes only through the search path."""
    connection.execute("SET LOCAL search_path = ag_catalog, public")
