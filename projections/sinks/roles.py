"""Least privilege: the SQL for a role that only reads and one that only tails."""

from collections.abc import Collection

from ._sql import statements


def roles_sql(sinks: Collection[str] = ("graph", "vectors")) -> str:
    """The statements for a database that holds ``sinks``, ready for psql."""
    parts = statements("roles")
    wanted = ["reader", "writer", *(name for name in ("graph", "vectors") if name in sinks)]
    return "\n\n".join(parts[name].as_string() for name in wanted) + "\n"
