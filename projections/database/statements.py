"""Statements kept in ``sql/*.sql``, one file for each subject.

A file may hold several statements, each under a line ``-- name: …``. ``{braces}`` are identifiers
put in by `psycopg.sql`, ``%(name)s`` are bind parameters; there is no third way for a value.
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
    text = files("projections.database").joinpath("sql", f"{file}.sql").read_text("utf-8")
    parts = _NAME.split(text)[1:]
    # Part of the program, not of its input: as literal as a string in this file.
    bodies = {
        name: cast("LiteralString", body.strip())
        for name, body in zip(parts[::2], parts[1::2], strict=True)
    }
    return {name: sql.SQL(body) for name, body in bodies.items()}


@cache
def tables() -> dict[str, sql.Identifier]:
    """The graph's label tables under their names in lower case, for the ``{braces}``."""
    return {label.lower(): sql.Identifier(GRAPH, label) for label in LABELS}
