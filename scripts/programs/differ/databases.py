"""Ways to rows in databases: a tail that is killed at statements and goes on, and a replay."""

import os
import random
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets, connect, ensure_extension
from projections.postgres.embedded import EmbeddedServer
from tests.support.rows import all_rows

from .outcomes import Chosen, Tally, folded, outcome

_TEMPLATE = "differ_template"
_MOST_KILLS = 2
_PATIENCE_MS = 30_000


class DatabaseWays:
    """Follows a log into some databases while it grows, and replays it into others at the end."""

    def __init__(
        self, log: Path, settings: Chosen, rng: random.Random, tally: Tally, server: EmbeddedServer
    ) -> None:
        self._log, self._settings, self._rng, self._tally = log, settings, rng, tally
        self._server = server

    @contextmanager
    def opened(self) -> Iterator["DatabaseWays"]:
        """With fresh databases: graph and vectors in one, or in two."""
        count = self._rng.choice((1, 2))
        with databases(self._server, count + 1) as urls:
            self._followed = Targets(urls[0], urls[count - 1])
            self._replayed = Targets(urls[-1], urls[-1])
            yield self

    def follow(self) -> None:
        """Let a tail catch up, after it was killed at random statements."""
        for _ in range(self._rng.randint(0, _MOST_KILLS)):
            _in_killed_process(int(10 ** self._rng.uniform(0, 2.5)), self._tail)
            for url in {self._followed.graph_url, self._followed.vector_url}:
                _end_sessions(url)
        outcome(self._tail)

    def _tail(self) -> None:
        size = self._rng.choice((1, 7, 1000))
        tail(self._log, self._followed, self._settings, once=True, batch_events=size)

    def compare(self, end: int) -> None:
        """The rows of the tail and of a replay are equal, and of the map of a fold."""
        expected = folded(self._log, self._settings, end, end)
        caught_up = outcome(self._tail)
        replayed = outcome(self._replay)
        if isinstance(expected, tuple):  # an event cannot be folded: a tail parks it
            self._tally.compare("replay refused", replayed, expected, end)
            if caught_up is not None:
                self._tally.compare("tail refused", caught_up, expected, end)
                return
            again = Targets(self._replayed.graph_url, self._replayed.vector_url)
            tail(self._log, again, self._settings, once=True)
        else:
            self._tally.compare("replay", (caught_up, replayed), (None, expected["digest"]), end)
        for part, one, other in zip(
            ("graph", "vectors", "maps"), all_rows(self._followed), all_rows(self._replayed),
            strict=True,
        ):  # fmt: skip
            self._tally.compare(f"rows of {part}", one, other, end)
        reports = check(self._log, self._followed, self._settings)
        sound = [(report.sound, report.differing, report.foreign) for report in reports]
        self._tally.compare("rows of a check", sound, [(True, 0, ())] * len(sound), end)

    def _replay(self) -> str:
        return rebuild(self._log, self._replayed, self._settings, hnsw=False, workers=0).digest


class _KillAt:
    """Kills this process at the n-th statement that psycopg sends."""

    def __init__(self, statements: int) -> None:
        self.left = statements
        for method in ("execute", "copy"):
            setattr(psycopg.Cursor, method, self._counting(getattr(psycopg.Cursor, method)))

    def _counting(self, original: Callable[..., Any]) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if self.left < 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return original(*args, **kwargs)

        return counted


def _in_killed_process(statements: int, work: Callable[[], Any]) -> None:
    """Do ``work`` in a process that is killed at a statement."""
    pid = os.fork()
    if pid == 0:
        try:
            _KillAt(statements)
            outcome(work)
        finally:
            os._exit(0)
    os.waitpid(pid, 0)


def _end_sessions(url: str) -> None:
    """Wait until the sessions of killed processes have ended."""
    with connect(url, autocommit=True) as connection:
        connection.execute(
            "SELECT pg_terminate_backend(pid, %s) FROM pg_stat_activity"
            " WHERE datname = current_database() AND pid <> pg_backend_pid()",
            [_PATIENCE_MS],
        )


@contextmanager
def databases(server: EmbeddedServer, count: int) -> Iterator[list[str]]:
    """URLs of fresh databases with both extensions, dropped at the end."""
    names = [f"differ_{number}" for number in range(count)]
    with connect(server.url, autocommit=True) as connection:
        found = connection.execute("SELECT FROM pg_database WHERE datname = %s", [_TEMPLATE])
        if found.fetchone() is None:
            connection.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(_TEMPLATE)))
            with connect(server.url_of(_TEMPLATE), autocommit=True) as inside:
                ensure_extension(inside, "age")
                ensure_extension(inside, "vector")
        for name in names:
            connection.execute(
                sql.SQL("CREATE DATABASE {} TEMPLATE {} STRATEGY FILE_COPY").format(
                    sql.Identifier(name), sql.Identifier(_TEMPLATE)
                )
            )
    try:
        yield [server.url_of(name) for name in names]
    finally:
        with connect(server.url, autocommit=True) as connection:
            for name in names:
                connection.execute(
                    sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name))
                )
