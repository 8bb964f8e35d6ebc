"""Every value that can reach the graph comes back from the real server as it was sent."""

import json
import math
from collections.abc import Iterator
from typing import Any

import psycopg
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from projections.postgres import graph_rows as agtype
from projections.postgres.loader import copy_to_graph, insert_into_graph
from tests.support.thorough import examples

ODD = ["\\", "\\\\n", '"', "'", "\t", "\\.", "\\N", "$$", "\u2028", "\x7f", "\x85", "😀"]
finite = st.floats(allow_nan=False, allow_infinity=False)
int64 = st.integers(-(2**63), 2**63 - 1)
anything = st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0"), max_size=40)
names = anything | st.sampled_from(ODD)


@pytest.fixture(scope="module")
def connection(pg_server: object, _template: str) -> Iterator[psycopg.Connection]:
    url = pg_server.url_of(_template)  # type: ignore[attr-defined]
    with psycopg.connect(url) as opened:
        opened.execute("SET search_path = ag_catalog, public")
        opened.execute("SELECT create_graph('agtype_trip'), create_vlabel('agtype_trip', 'Thing')")
        yield opened
        opened.rollback()


def trip(connection: psycopg.Connection, load_of: Any, texts: list[str]) -> list[str]:
    """Write properties, read them back as text, leave nothing."""
    with connection.transaction(force_rollback=True):
        base = 3 << 48
        rows = [(base + i, text) for i, text in enumerate(texts, 1)]
        load_of("agtype_trip", "Thing", rows)(connection)
        found = connection.execute(
            'SELECT properties FROM agtype_trip."Thing" ORDER BY id'
        ).fetchall()
    return [row[0] for row in found]


@settings(
    max_examples=examples(150),
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(st.lists(st.tuples(names, finite, int64, st.lists(finite)), min_size=1))
@pytest.mark.parametrize("load_of", [copy_to_graph, insert_into_graph])
def test_values_come_back_from_the_server_as_sent(
    connection: psycopg.Connection,
    load_of: Any,
    values: list[tuple[str, float, int, list[float]]],
) -> None:
    texts = [
        f'{{"s": {agtype.text(s)}, "f": {agtype.number(f)}, "i": {i},'
        f' "l": [{", ".join(map(repr, many))}]}}'
        for s, f, i, many in values
    ]
    for text, (s, f, i, many) in zip(trip(connection, load_of, texts), values, strict=True):
        back = json.loads(text, strict=False)
        assert back["s"] == s
        assert type(back["i"]) is int
        assert back["i"] == i
        assert same_float(back["f"], f)
        assert len(back["l"]) == len(many)
        assert all(same_float(b, m) for b, m in zip(back["l"], many, strict=True))


def same_float(found: object, sent: float) -> bool:
    """A float, equal, and of the same sign even when zero."""
    return (
        type(found) is float and found == sent and math.copysign(1, found) == math.copysign(1, sent)
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [(1.0, "1.0"), (-0.0, "-0.0"), (1e22, "1e+22"), (5e-324, "5e-324"), (0.1, "0.1")],
)
def test_a_float_has_a_point_or_an_exponent(value: float, text: str) -> None:
    assert agtype.number(value) == text


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_infinity_and_nan_are_refused(value: float) -> None:
    with pytest.raises(ValueError, match="no number"):
        agtype.number(value)
