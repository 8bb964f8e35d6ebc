"""AGE graphs: create, find, index, count, lock, swap and drop them.

AGE keeps a graph as a schema, so a graph is *ours* when the schema carries our mark as its comment.
Anything else under these names belongs to another program: it is refused and never changed, except
that an empty graph, as scripts that set up a database make it, is taken over (`adopt_if_empty`).

The swap renames the old graph; it is dropped later, when every transaction that may still have
looked up its name has ended (see `swap`).
"""

from collections.abc import Collection
from itertools import count
from typing import Final

from psycopg import sql

from eventsrc.base.advised import advised
from projections.fold.errors import DatabaseError, ProjectionMismatch

from . import replaced_tables
from .connection import Connection, describe_connection
from .cypher import PARENTS, add_policies
from .labels import (
    CHANGING_EDGES,
    EDGE_LABELS,
    GRAPH,
    KEYS,
    LABEL_IDS,
    LABELS,
    MATCHED,
    OLD_GRAPH,
    VERTEX_LABELS,
    Label,
)
from .statements import statements

_MARK: Final = "mapfold"


def exists(connection: Connection, graph: str) -> bool:
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


def adopt_if_empty(connection: Connection, graph: str) -> None:
    """Take over a graph that another program made and that has no vertex, edge or other table.
    Inside a transaction. The rights on its schema stay, unless it has labels: then another one
    takes its place, because labels get their numbers in the order in which they are made. It is
    renamed and dropped with the next replay: AGE 1.5 may end a session that drops a graph."""
    run = statements("graph")
    row = connection.execute(run["state"], {"graph": graph}).fetchone()
    if row is None or not row[0] or row[1] or not _is_empty(connection, graph):
        return
    if not is_bare(connection, graph) and exists(connection, OLD_GRAPH):
        return  # its place is taken until the next replay
    parents = sql.SQL(", ").join(sql.Identifier(graph, parent) for parent in PARENTS)
    connection.execute(run["lock"].format(tables=parents))
    if not _is_empty(connection, graph):  # written to meanwhile
        return
    _use_age(connection)
    connection.execute(run["mark"].format(graph=sql.Identifier(graph)))
    if not is_bare(connection, graph):
        drop_later = {"graph": graph, "new_name": OLD_GRAPH}
        connection.execute(run["rename_graph"], drop_later)
        connection.execute(run["create_graph"], {"graph": graph})
        connection.execute(run["mark"].format(graph=sql.Identifier(graph)))


def _is_empty(connection: Connection, graph: str) -> bool:
    vertices, edges = (sql.Identifier(graph, parent) for parent in PARENTS)
    query = statements("graph")["is_empty"].format(vertices=vertices, edges=edges)
    row = connection.execute(query, {"graph": graph}).fetchone()
    return row is not None and bool(row[0])


def is_bare(connection: Connection, graph: str) -> bool:
    """Whether a graph has no labels but those that every graph has."""
    return set(_label_ids(connection, graph)) <= set(PARENTS)


def create(connection: Connection, graph: str) -> None:
    """An empty graph with all labels."""
    _use_age(connection)
    run = statements("graph")
    connection.execute(run["create_graph"], {"graph": graph})
    connection.execute(run["mark"].format(graph=sql.Identifier(graph)))
    add_labels(connection, graph)


def add_labels(connection: Connection, graph: str) -> None:
    """All labels of a graph that has none, in the order that gives them their constant ids."""
    _use_age(connection)
    run = statements("graph")
    for label in LABELS:
        kind = "create_vlabel" if label in VERTEX_LABELS else "create_elabel"
        connection.execute(run[kind], {"graph": graph, "label": label})
    for name in LABELS:
        table = sql.Identifier(graph, name)
        connection.execute(run["no_statistics"].format(table=table))
    add_policies(connection, graph)
    found = _label_ids(connection, graph)
    if any(found.get(label) != number for label, number in LABEL_IDS.items()):
        raise DatabaseError(
            f"{describe_connection(connection)}: this version of Apache AGE numbers labels in"
            f" another way ({found}); use AGE 1.5 to 1.8"
        )


def _label_ids(connection: Connection, graph: str) -> dict[str, int]:
    rows = connection.execute(statements("graph")["label_ids"], {"graph": graph}).fetchall()
    return dict(rows)


def refuse_older(connection: Connection, graph: str) -> None:
    """Raise ProjectionMismatch for a graph that an older mapfold made, which lacks labels."""
    missing = [label for label in LABELS if label not in _label_ids(connection, graph)]
    if missing:
        raise ProjectionMismatch(
            f"{describe_connection(connection)}: an older mapfold made the graph there: it has no"
            f" {', '.join(missing)}; run `{advised('replay')}`, which makes it again"
        )


def index(
    connection: Connection, graph: str, labels: Collection[Label] = frozenset(LABELS)
) -> None:
    """Create the indexes for queries and upserts that AGE has not made itself."""
    run = statements("graph")
    rows = connection.execute(run["indexed"], {"graph": graph}).fetchall()
    unique = {(table, column): is_unique for table, column, is_unique in rows}
    schema = sql.Identifier(graph)
    for label in filter(labels.__contains__, LABELS):
        table = sql.Identifier(label)
        if (label in VERTEX_LABELS or label in CHANGING_EDGES) and not unique.get((label, "id")):
            column = sql.Identifier("id")
            connection.execute(run["index_unique"].format(graph=schema, label=table, column=column))
        for end in ("start_id", "end_id") if label in EDGE_LABELS else ():
            if (label, end) not in unique:
                column = sql.Identifier(end)
                connection.execute(run["index"].format(graph=schema, label=table, column=column))
    for vertex, key in KEYS.items():
        if vertex not in labels:
            continue
        literal = sql.Literal(f'"{key}"')
        table = sql.Identifier(vertex)
        connection.execute(run["index_key"].format(graph=schema, label=table, key=literal))
    for vertex in filter(labels.__contains__, MATCHED):
        connection.execute(run["index_match"].format(graph=schema, label=sql.Identifier(vertex)))


def counts(connection: Connection, graph: str) -> dict[str, int]:
    """Rows by label."""
    selects = [
        sql.SQL("SELECT {}, count(*) FROM {}").format(
            sql.Literal(label), sql.Identifier(graph, label)
        )
        for label in LABELS
    ]
    return dict(connection.execute(sql.SQL(" UNION ALL ").join(selects)).fetchall())


def lock(connection: Connection, graph: str) -> None:
    """Lock all tables of a graph exclusively, if it is there; an older version's has fewer."""
    if exists(connection, graph):
        there = _label_ids(connection, graph)
        names = [*PARENTS, *filter(there.__contains__, LABELS)]
        tables = sql.SQL(", ").join(sql.Identifier(graph, name) for name in names)
        connection.execute(statements("graph")["lock"].format(tables=tables))


def swap_in(connection: Connection, shadow: str) -> None:
    """Rename the readers' graph to `OLD_GRAPH` and ``shadow`` to the readers' name."""
    _use_age(connection)
    run = statements("graph")
    if exists(connection, GRAPH):
        connection.execute(run["rename_graph"], {"graph": GRAPH, "new_name": OLD_GRAPH})
    connection.execute(run["rename_graph"], {"graph": shadow, "new_name": GRAPH})


def drop(connection: Connection, graph: str) -> None:
    """Drop a graph of ours, if it is there."""
    if exists(connection, graph):
        _use_age(connection)
        with connection.cursor() as cursor:
            cursor.execute("SET LOCAL client_min_messages = warning")
            cursor.execute(statements("graph")["drop_graph"], {"graph": graph})


def drop_in_background(connection: Connection, graph: str) -> None:
    """Have the server drop a graph of ours, if it is there; closes the connection then."""
    if exists(connection, graph):
        connection.execute("SET search_path = ag_catalog, public")
        replaced_tables.send_and_close(
            connection, statements("graph")["drop_named"].format(graph=sql.Literal(graph))
        )


def analyze(connection: Connection, graph: str) -> None:
    """Gather statistics, so that the planner knows which labels are large.

    Inside a transaction. The keys that readers look up are nearly unique, which a small sample
    shows.
    """
    connection.execute(statements("graph")["sample"])
    for label in LABELS:
        connection.execute(
            statements("graph")["analyze"].format(
                graph=sql.Identifier(graph), label=sql.Identifier(label)
            )
        )


def _use_age(connection: Connection) -> None:
    """AGE's own functions find their operator classes only through the search path."""
    connection.execute("SET LOCAL search_path = ag_catalog, public")
