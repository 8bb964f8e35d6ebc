"""`mapfold serve` as a command, its limits, and what it does without its database."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from eventsrc.record.transport.session import Router, ZenohOptions, open_session
from projections.fold.map_errors import DatabaseError, DatabaseUnavailable, ProjectionMissing
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Connection, Targets, connect
from projections.postgres.embedded import EmbeddedServer
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.answering import HEALTH_S, TokenBucket, TooMuchError
from tests.support.commands import Commands, ReadyProgram
from tests.support.fixtures_zenoh import LOOPBACK
from tests.support.logs import walk, write_log
from tests.support.serve_questions import DEADLINE_S, ask, fetch, http_at, question
from tests.support.servers import kill_postgres, server_to_kill


def test_too_many_questions_are_refused_not_queued_forever(pools: Pools) -> None:
    slow = Answerer(pools, per_second=0.01)
    slow.relocalize(question(), {})
    with pytest.raises(TooMuchError, match="a second"):
        slow.relocalize(question(), {})


def test_the_bucket_fills_with_time() -> None:
    now = [0.0]
    bucket = TokenBucket(2.0, now=lambda: now[0])
    for _ in range(4):
        bucket.take_token()
    with pytest.raises(TooMuchError):
        bucket.take_token()
    now[0] = 0.5
    bucket.take_token()
    with pytest.raises(TooMuchError):
        bucket.take_token()


def test_the_command_serves_until_sigterm(
    endpoint: str, walked_map: Targets, tmp_path: Path
) -> None:
    read, write = os.pipe()
    mapfold = Commands.in_folder(tmp_path)
    started = mapfold.start(
        "serve", "--connect", endpoint, "--db", walked_map.graph_url, stderr=write
    )
    os.close(write)
    program = ReadyProgram(started, read, DEADLINE_S, DEADLINE_S)
    try:
        with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
            assert ask(session, "mapfold/relocalize", question())[0]
    finally:
        code = program.end()
    assert code == 0
    assert "service ended" in program.text


def test_http_answers_without_a_router_and_zenoh_when_one_is_there(
    walked_map: Targets, tmp_path: Path
) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    read, write = os.pipe()
    words = ("--http", "127.0.0.1:0", "--connect", away, "--db", walked_map.graph_url)
    started = Commands.in_folder(tmp_path).start("serve", *words, stderr=write)
    os.close(write)
    program = ReadyProgram(started, read, DEADLINE_S, DEADLINE_S)
    try:
        assert program.said[0] == (
            f"no Zenoh router or peer answers at {away}; start one with `mapfold router --listen"
            f" {away}` or say where it is with --connect; it is joined when it answers"
        )
        (url,) = re.findall(r"answering (http://\S+),", program.text)
        assert fetch(f"{url}/health")[1]["status"] == "ok"
        options = ZenohOptions(connect=(away,))
        with (
            Router(ZenohOptions(listen=(away,))),
            open_session(options, mode="client") as session,
        ):
            give_up = time.monotonic() + DEADLINE_S
            replies: list[tuple[bool, bytes]] = []
            while not replies and time.monotonic() < give_up:
                replies = session.get_replies("mapfold/relocalize", question(), timeout_s=1.0)
        assert [good for good, _ in replies] == [True]
    finally:
        code = program.end()
    assert code == 0


def test_without_http_a_missing_router_is_one_line(walked_map: Targets, tmp_path: Path) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    mapfold = Commands.in_folder(tmp_path)
    said = mapfold("serve", "--connect", away, "--db", walked_map.graph_url, code=1).err
    assert said.startswith(f"mapfold: no Zenoh router or peer answers at {away}; start one")


class TestKilledServer:
    """PostgreSQL dies under the service."""

    @pytest.fixture
    def server(self, tmp_path: Path) -> Iterator[EmbeddedServer]:
        with server_to_kill() as server:
            targets = Targets(server.url, server.url)
            rebuild(write_log(tmp_path / "log", walk(60, seed=3)), targets, Settings())
            yield server

    @pytest.mark.slow
    def test_the_embedded_server_is_restarted(self, server: EmbeddedServer) -> None:
        notes: list[str] = []
        with Pools(Targets(server.url, server.url, server), 4, notes.append) as pools:
            answerer = Answerer(pools, per_second=10_000.0)
            before = answerer.relocalize(question(), {})
            for _ in range(2):
                kill_postgres(server)
                assert answerer.relocalize(question(), {}) == before
            kill_postgres(server)
            assert answerer.health() == {"status": "ok"}
            assert answerer.relocalize(question(), {}) == before
        assert [line.endswith("trying again") for line in notes[:4]] == [True, False, True, False]

    @pytest.mark.slow
    def test_questions_wait_for_another_server_at_first_and_fail_at_once_later(
        self, server: EmbeddedServer, queue: FairQueue, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("projections.surfaces.serve.pools.OUTAGE_TIMEOUT_S", 0.5)
        notes: list[str] = []
        with Pools(Targets(server.url, server.url), 4, notes.append) as pools:
            answerer = Answerer(pools, per_second=10_000.0)
            answerer.relocalize(question(), {})
            kill_postgres(server)
            with http_at(answerer, queue) as port:
                for path, data in (("relocalize", question()), ("health", None)):
                    status, document = fetch(f"http://127.0.0.1:{port}/{path}", data)
                    assert (status, document["error"]["kind"]) == (503, "database")
            monkeypatch.setattr("projections.surfaces.serve.pools.OUTAGE_TIMEOUT_S", 2 * DEADLINE_S)
            assert not answerer.database_up
            begun = time.monotonic()
            with pytest.raises(DatabaseUnavailable, match="start the server"):
                answerer.relocalize(question(), {})
            assert time.monotonic() - begun < DEADLINE_S
            assert len(notes) == 1
            server.start()
            assert answerer.relocalize(question(), {})["places"]
            assert answerer.database_up
        assert notes[1:] == ["the database answers again"]


@pytest.mark.slow
def test_a_full_pool_is_not_reported_as_an_outage(
    walked_map: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_WAIT_S", "LAST_WAIT_S"):
        monkeypatch.setattr(f"projections.surfaces.serve.pools.{name}", 0.5)
    notes: list[str] = []
    with Pools(walked_map, 1, notes.append) as pools:

        def ask_too(_: Connection) -> None:
            with pytest.raises(DatabaseUnavailable, match="none of the 1 connections came free"):
                pools.on_graph(lambda _: None)

        pools.on_graph(ask_too)
    assert notes == []


def test_it_does_not_start_without_a_map(one_database: Targets) -> None:
    with pytest.raises(ProjectionMissing, match="run `mapfold replay"):
        Pools(one_database, 1)


def test_health_is_at_most_a_second_old_and_fresh_after_a_question_that_failed(
    one_database: Targets, tmp_path: Path
) -> None:
    log = write_log(tmp_path / "log", walk(60, seed=3))
    rebuild(log, one_database, Settings())
    now = [0.0]
    with (
        connect(one_database.graph_url, autocommit=True) as owner,
        Pools(one_database, 2) as pools,
    ):
        answerer = Answerer(pools, per_second=10_000.0, now=lambda: now[0])

        def healthy() -> bool:
            try:
                return answerer.health() == {"status": "ok"}
            except ProjectionMissing:
                return False

        assert healthy()
        owner.execute("DELETE FROM mapfold.checkpoint")
        now[0] += HEALTH_S / 2
        assert healthy()
        now[0] += HEALTH_S / 2
        assert not healthy()
        rebuild(log, one_database, Settings())
        assert not healthy()
        now[0] += HEALTH_S
        assert healthy()
        owner.execute("DELETE FROM mapfold.checkpoint")
        owner.execute("ALTER TABLE detection_embeddings RENAME TO elsewhere")
        with pytest.raises(ProjectionMissing):
            answerer.relocalize(question(), {})
        assert not healthy()


def test_health_tries_a_question(one_database: Targets, tmp_path: Path) -> None:
    """Server, checkpoints and rows are there, and yet no question can be answered."""
    rebuild(write_log(tmp_path / "log", walk(10)), one_database, Settings())
    with Pools(one_database, 1) as pools:
        answerer = Answerer(pools, per_second=10_000.0)
        with connect(one_database.graph_url, autocommit=True) as owner:
            owner.execute("ALTER TABLE detection_embeddings RENAME COLUMN map_yaw TO turned")
        with pytest.raises(DatabaseError, match=r'"map_yaw" does not exist'):
            answerer.health()


@pytest.mark.slow
def test_a_cut_connection_is_reported_in_one_line_of_ours(walked_map: Targets) -> None:
    program = subprocess.Popen(
        [
            *(sys.executable, "-m", "projections.surfaces.cli", "serve", "--no-zenoh"),
            *("--http", "127.0.0.1:0", "--db", walked_map.graph_url),
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert program.stderr is not None
        url = program.stderr.readline().split()[1].rstrip(",")
        assert fetch(f"{url}/relocalize", question())[0] == 200
        with connect(walked_map.graph_url, autocommit=True) as killer:
            killer.execute(
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity"
                " WHERE application_name = 'mapfold serve' AND datname = current_database()"
            )
        assert fetch(f"{url}/relocalize", question())[0] == 200
    finally:
        program.terminate()
        program.wait(DEADLINE_S)
    with program.stderr:
        lines = program.stderr.read().splitlines()  # not communicate(): readline() has read ahead
    assert lines[0] == "Ctrl-C ends it"
    assert lines[1].startswith("mapfold: database ")
    assert lines[2:] == ["mapfold: the database answers again", "service ended"]
