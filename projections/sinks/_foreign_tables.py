"""Find what somebody else keeps in the schema of our graph: labels, tables, rows without a label.

``CREATE (n:Door)`` makes a label, which is a table; rows without a label stand in the tables that
all labels inherit from. A rebuild replaces the graph and so drops both.
"""

from dataclasses import dataclass
from typing import Final

from psycopg import sql

from projections.postgres.connect import Connection

from ._cypher_guard import PARENTS
from ._sql import statements
from .labels import GRAPH, LABELS

_KINDS: Final = {"v": "VIEW", "m": "MATERIALIZED VIEW", "f": "FOREIGN TABLE"}


@dataclass(frozen=True, slots=True)
class ForeignTable:
    """A table in the graph's schema with rows that are not ours.

    ``rows`` is None when they are not for us to read. ``keep`` is SQL that copies them elsewhere,
    ``remove`` is SQL that drops them.
    """

    table: str
    what: str
    rows: int | None
    keep: str
    remove: str


def foreign_tables(connection: Connection) -> tuple[ForeignTable, ...]:
    """All of them, by name."""
    values = {"graph": GRAPH, "ours": list(LABELS)}
    found = []
    for name, kind, label, readable in connection.execute(
        statements("foreign_tables")["tables"], values
    ).fetchall():
        rows = _count(connection, name) if readable else None
        if name in PARENTS and not rows:
            continue
        found.append(_described(connection, name, kind, label, rows))
    return tuple(found)


def _count(connection: Connection, name: str) -> int:
    query = sql.SQL("SELECT count(*) FROM ONLY {}").format(sql.Identifier(GRAPH, name))
    row = connection.execute(query).fetchone()
    return 0 if row is None else int(row[0])


def _described(
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
        what = _KINDS.get(kind, "TABLE").lower()
        remove = sql.SQL("DROP {} {}").format(sql.SQL(_KINDS.get(kind, "TABLE")), table)
    # A table of its own leaves the schema whole; a label would stay a part of the graph.
    keep = sql.SQL("CREATE TABLE {} AS SELECT * FROM ONLY {}").format(copy, table)
    return ForeignTable(name, what, rows, keep.as_string(connection), remove.as_string(connection))
