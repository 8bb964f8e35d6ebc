"""Keep roles that may only read a graph from writing it through ``cypher()``.

Table privileges do not (see `projections.database.age_version`); row-level security does, from AGE
1.7 on. So each table of a graph of ours gets policies that repeat its privileges: a role may change
rows through ``cypher()`` if and only if it may change them through SQL. They do not apply to the
owner.

With an older AGE nothing holds but having no USAGE on ``ag_catalog``, so that ``cypher`` cannot be
named; ``mapfold db roles`` gives it to readers only where the policies are in force.
"""

from typing import Final

from psycopg import sql

from .age_version import enforces_row_security
from .connection import Connection, extension_version
from .labels import GRAPH, LABELS
from .statements import statements

PARENTS: Final = ("_ag_label_vertex", "_ag_label_edge")
"""The tables that AGE has all labels' tables inherit from."""


def guard(connection: Connection, graph: str) -> None:
    """Put the policies on all tables of a graph, if this version of AGE heeds them."""
    if not enforces_row_security(extension_version(connection, "age") or ""):
        return
    for label in (*PARENTS, *LABELS):
        table = sql.Identifier(graph, label)
        name = sql.Literal(table.as_string(connection))
        connection.execute(statements("cypher_guard")["guard"].format(table=table, name=name))


def unwanted_writers(connection: Connection) -> list[str]:
    """Roles that can change the graph through ``cypher()`` and by their privileges must not."""
    version = extension_version(connection, "age")
    if version is None:
        return []
    values = {"graph": GRAPH, "enforced": enforces_row_security(version)}
    rows = connection.execute(statements("cypher_guard")["unwanted_writers"], values).fetchall()
    return [str(name) for (name,) in rows]


def subject(connection: Connection) -> bool:
    """Whether the policies apply to us, who are not the owner: COPY cannot write such tables."""
    table = sql.Identifier(GRAPH, LABELS[0]).as_string(connection)
    row = connection.execute(statements("cypher_guard")["subject"], {"table": table}).fetchone()
    return row is not None and bool(row[0])
