"""Statements kept in ``sql/*.sql`` of this package, by file and name (see `projections.sinks`)."""

import re
from functools import cache
from importlib.resources import files
from typing import LiteralString, cast

from psycopg import sql

from projections.sinks.labels import GRAPH, LABELS

_NAME = re.compile(r"^-- name: (\w+)$", re.MULTILINE)


@cache
def statements(file: str) -> dict[str, sql.SQL]:
    """The statements of ``sql/<file>.sql`` by name."""
    text = files("projections.queries").joinpath("sql", f"{file}.sql").read_text("utf-8")
    parts = _NAME.split(text)[1:]
    # Part of the program, not of its input: as literal as a string in this file.
    return {
        name: sql.SQL(cast("LiteralString", body.strip()))
        for name, body in zip(parts[::2], parts[1::2], strict=True)
    }


@cache
def tables() -> dict[str, sql.Identifier]:
    """The graph's label tables under their names in lower case, for the ``{braces}``."""
    return {label.lower(): sql.Identifier(GRAPH, label) for label in LABELS}
