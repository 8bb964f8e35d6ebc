"""Fleets for tests: a few sites with small logs, and databases of the test run's own server."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from psycopg import sql

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload
from projections.fold.settings import Settings
from projections.postgres.check import check
from projections.postgres.connection import Targets, connect
from projections.postgres.embedded import EmbeddedServer
from tests.support.envelopes import payload
from tests.support.logs import KEY, walk, write_log

_numbers = count()


@contextmanager
def fleet_databases(server: EmbeddedServer) -> Iterator[str]:
    """A template for ``--db`` whose databases are dropped afterwards."""
    prefix = f"fleet_{os.getpid()}_{next(_numbers)}_"
    yield server.url_of(f"{prefix}SITE").replace("SITE", "{site}")
    with connect(server.url, autocommit=True) as connection:
        rows = connection.execute(
            "SELECT datname FROM pg_database WHERE starts_with(datname, %s)", [prefix]
        )
        for (name,) in rows.fetchall():
            connection.execute(
                sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name))
            )


def write_sites(folder: Path, names: list[str], keyframes: int) -> Path:
    """A log in each subfolder, each of another robot in another building."""
    for seed, name in enumerate(names):
        write_log(folder / name, walk(keyframes, seed=seed, run_id=f"run-{seed}"))
    return folder


def extend(log: Path, seed: int, keyframes: int, *, first: int) -> None:
    """Append further keyframes of the run that `write_sites` began."""
    with LogWriter(log, fsync=NEVER) as writer:
        for document in walk(keyframes, seed=seed, run_id=f"run-{seed}", first=first):
            append_payload(writer, KEY, payload(document))


def wrong_rows(log: Path, url: str) -> int:
    """How many rows of the databases are not those of the log as it is now; all where the
    databases are at another offset."""
    reports = check(log, Targets(url, url), Settings())
    with LogWriter(log, fsync=NEVER) as writer:
        end = writer.next_offset
    return sum(
        report.differing if report.next_offset == end else report.rows + 1 for report in reports
    )
