"""Least privilege: the SQL for a role that only reads and one that only tails."""

from collections.abc import Collection

from psycopg import sql

from projections.postgres.age import FIRST_TO_ENFORCE

from ._sql import statements


def roles_sql(sinks: Collection[str] = ("graph", "vectors")) -> str:
    """The statements for a database that holds ``sinks``, ready for psql."""
    parts = statements("roles")
    wanted = ["reader", "writer", *(name for name in ("graph", "vectors") if name in sinks)]
    first = sql.Literal(list(FIRST_TO_ENFORCE))
    return "\n\n".join(parts[name].format(first=first).as_string() for name in wanted) + "\n"
