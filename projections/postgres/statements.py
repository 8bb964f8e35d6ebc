"""SQL statements, loaded from ``sql/*.sql``.

A file holds several statements, each under a line ``-- name: …``. ``{braces}`` are identifiers that
`psycopg.sql` quotes, ``%(name)s`` are bind parameters; no value gets in otherwise.
"""

import re
from functools import cache
from importlib.resources import files
from typing import LiteralString, cast

from psycopg import sql

from .labels import GRAPH, LABELS

_NAME = re.compile(r"^-- name: (\w+)$", re.MULTILINE)


@cache
def statements(file: str) -> dict[str, sql.SQL]:
    """The statements of ``sql/<file>.sql`` by name."""
    text = files("projections.postgres").joinpath("sql", f"{file}.sql").read_text("utf-8")
    parts = _NAME.split(text)[1:]
    # The files are part of the program, so their text is as literal as a string here.
    bodies = {
        name: cast("LiteralString", body.strip())
        for name, body in zip(parts[::2], parts[1::2], strict=True)
    }
    return {name: sql.SQL(body) for name, body in bodies.items()}


@cache
def tables() -> dict[str, sql.Identifier]:
    """Identifiers of the label tables by label in lower case, for the ``{braces}``."""
    return {label.lower(): sql.Identifier(GRAPH, label) for label in LABELS}
