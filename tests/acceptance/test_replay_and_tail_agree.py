"""However the databases came to be, their rows are the same; and the log alone decides them."""

from pathlib import Path
from typing import Any

import psycopg
import pytest
from psycopg import sql

from tests.acceptance.awkward_run import awkward_payloads
from tests.support.commands import Commands
from tests.support.thorough import stride

Rows = dict[str, list[tuple[Any, ...]]]


def everything(url: str) -> Rows:
    """Every row of every label and of the vector table, as text, ids included."""
    with psycopg.connect(url) as connection:
        connection.execute("LOAD 'age'")
        connection.execute('SET search_path = ag_catalog, "$user", public')
        labels = connection.execute(
            "SELECT l.name FROM ag_label l JOIN ag_graph g ON g.graphid = l.graph"
            " WHERE g.name = 'semantic_map' ORDER BY 1"
        ).fetchall()
        tables = [sql.Identifier("semantic_map", name) for (name,) in labels]
        tables.append(sql.Identifier("detection_embeddings"))
        rows: Rows = {}
        for table in tables:
            query = sql.SQL("SELECT t::text FROM {} t ORDER BY 1").format(table)
            rows[table.as_string(connection)] = connection.execute(query).fetchall()
    return rows


def new_database(mapfold: Commands, name: str) -> str:
    """An empty database on the embedded server."""
    base = mapfold("db", "url").out.strip()
    with psycopg.connect(base, autocommit=True) as connection:
        connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
    info = psycopg.conninfo.conninfo_to_dict(base)
    return f"postgresql://{info['user']}@/{name}?host={info['host']}"


def test_tail_from_nothing_equals_replay_and_both_may_run_twice(
    mapfold: Commands, awkward_log: Path
) -> None:
    replayed, tailed = new_database(mapfold, "replayed"), new_database(mapfold, "tailed")
    mapfold("replay", awkward_log, "--db", replayed)
    first = everything(replayed)
    assert sum(map(len, first.values())) > 200
    mapfold("tail", awkward_log, "--once", "--db", tailed)
    assert everything(tailed) == first
    mapfold("tail", awkward_log, "--once", "--db", tailed)
    assert everything(tailed) == first
    mapfold("replay", awkward_log, "--db", replayed)
    assert everything(replayed) == first
    mapfold("tail", awkward_log, "--once", "--db", replayed)
    assert everything(replayed) == first


@pytest.mark.slow
def test_graph_and_vectors_may_live_in_two_databases(mapfold: Commands, awkward_log: Path) -> None:
    both = new_database(mapfold, "both")
    graph, vectors = new_database(mapfold, "graph_only"), new_database(mapfold, "vectors_only")
    mapfold("replay", awkward_log, "--db", both)
    mapfold("replay", awkward_log, "--db", graph, "--vector-db", vectors)
    whole = everything(both)
    with psycopg.connect(vectors) as connection:
        found = connection.execute("SELECT t::text FROM detection_embeddings t ORDER BY 1")
        assert found.fetchall() == whole['"detection_embeddings"']
    with psycopg.connect(graph) as connection:
        found = connection.execute('SELECT t::text FROM semantic_map."Keyframe" t ORDER BY 1')
        assert found.fetchall() == whole['"semantic_map"."Keyframe"']


def test_the_digest_is_the_logs_own(mapfold: Commands, awkward_log: Path) -> None:
    digest = mapfold("state", awkward_log, "--digest").out
    assert len(digest.strip()) == 64
    assert mapfold("state", awkward_log, "--digest").out == digest


@pytest.mark.slow
def test_a_past_state_is_the_state_of_a_shorter_log(mapfold: Commands, awkward_log: Path) -> None:
    payloads = awkward_payloads()
    for count in (1, 0, 17, 5, 20, len(payloads))[stride(2) - 1 :: stride(2)]:
        short = mapfold.folder / f"short-{count}"
        mapfold("import", short, "-", stdin=b"".join(p + b"\n" for p in payloads[:count]))
        past = mapfold("state", awkward_log, "--at", str(count), "--json").json
        assert past == mapfold("state", short, "--json").json
        assert past["offset"] == count


@pytest.mark.slow
def test_a_file_that_says_all_twice_is_folded_once(mapfold: Commands) -> None:
    lines = b"".join(p + b"\n" for p in awkward_payloads())
    once, twice = mapfold.folder / "once", mapfold.folder / "twice"
    mapfold("import", once, "-", stdin=lines)
    mapfold("import", twice, "-", stdin=lines + lines)
    assert mapfold("state", twice, "--digest").out == mapfold("state", once, "--digest").out
    counts = mapfold("state", twice, "--json").json["counts"]
    assert counts["duplicates"] == len(awkward_payloads())
