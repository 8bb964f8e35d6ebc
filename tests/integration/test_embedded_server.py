"""The embedded server: shared by commands, stopped by the last, never left running."""

import os
import select
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import psycopg
import pytest

from projections.fold.map_errors import DatabaseUnavailable, EmbeddedServerError
from projections.postgres.connection import connect, database_errors
from projections.postgres.embedded import EmbeddedServer
from tests.support.commands import Commands
from tests.support.logs import walk, write_log
from tests.support.prefork import Process, start
from tests.support.servers import furnish
from tests.support.thorough import mostly_slow

WAIT_S = 60

HOLDER = """
import sys, signal
# A shell that runs the tests in its background has its children ignore Ctrl-C.
signal.signal(signal.SIGINT, signal.default_int_handler)
from projections.surfaces.cli.options import Databases
from projections.surfaces.cli.program import run_app

def command():
    with Databases().opened() as targets:
        print(targets.graph_url, flush=True)
        sys.stdin.read()

run_app(command)
"""


@pytest.fixture(scope="module")
def furnished() -> Iterator[Path]:
    """A home with a data folder, whose server each test leaves stopped."""
    with tempfile.TemporaryDirectory(prefix="mapfold-test-home-") as folder:
        yield furnish(Path(folder))


@pytest.fixture
def home(furnished: Path) -> Iterator[Path]:
    yield furnished
    EmbeddedServer(furnished).stop(discard_keep=True)


@contextmanager
def holder(home: Path) -> Iterator[tuple[Process, IO[bytes]]]:
    """Another process that uses the server of ``home`` until its stdin, the pipe, is closed."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith("MAPFOLD_")}
    environment["MAPFOLD_HOME"] = str(home)
    (stdin, given), (said, stdout) = os.pipe(), os.pipe()
    with os.fdopen(given, "wb") as pipe, os.fdopen(said) as lines:
        process = start(HOLDER, ["-c"], env=environment, cwd=home, stdin=stdin, stdout=stdout)
        os.close(stdin)
        os.close(stdout)
        try:
            assert lines.readline().startswith("postgresql://")
            yield process, pipe
        finally:
            process.kill()
            process.wait(WAIT_S)


def answers(server: EmbeddedServer) -> bool:
    try:
        with psycopg.connect(server.url) as connection:
            return connection.execute("SELECT 1").fetchone() == (1,)
    except psycopg.OperationalError:
        return False


@pytest.mark.slow
def test_starts_serves_and_stops_at_a_path_with_spaces_quotes_and_percent() -> None:
    with tempfile.TemporaryDirectory(prefix="mapfold-test-home-") as folder:
        with EmbeddedServer(Path(folder) / "my robot's 100% café") as server:
            assert answers(server)
            assert server.data.stat().st_mode & 0o077 == 0
        assert not server.running
        assert not answers(server)


@pytest.mark.slow
def test_two_commands_share_it_and_the_last_one_stops_it(home: Path) -> None:
    with EmbeddedServer(home) as server, holder(home) as (other, pipe):
        server.stop()
        assert answers(server)
        pipe.close()
        assert other.wait(WAIT_S) == 0
        assert not server.running


@pytest.mark.skipif(os.geteuid() != 0, reason="only root has the server run as another user")
def test_a_folder_closed_while_it_runs_is_opened_to_the_servers_user_again(home: Path) -> None:
    with EmbeddedServer(home) as server:
        home.chmod(0o700)  # as each new pytest does with the folder above its temporary ones
        with EmbeddedServer(home), psycopg.connect(server.url) as connection:
            # By its whole path, as extensions are loaded: the server itself works in the folder.
            sql = "SELECT pg_read_file(%s)"
            path = str(server.data / "PG_VERSION")
            assert connection.execute(sql, [path]).fetchone() is not None


def test_db_start_keeps_it_and_db_stop_ends_that(home: Path) -> None:
    server = EmbeddedServer(home).start(keep=True)
    assert server.stop() is True
    with EmbeddedServer(home) as again:
        assert answers(again)
    assert server.running
    assert server.stop(discard_keep=True) is False
    assert not server.running


def test_db_stop_does_not_stop_a_server_in_use(home: Path) -> None:
    with holder(home) as (other, _):
        server = EmbeddedServer(home)
        assert server.stop(discard_keep=True) is True
        assert answers(server)
        assert other.poll() is None


@pytest.mark.parametrize("signum", mostly_slow([signal.SIGHUP, signal.SIGTERM, signal.SIGINT]))
def test_a_signal_leaves_no_server_behind(home: Path, signum: signal.Signals) -> None:
    with holder(home) as (other, _):
        assert EmbeddedServer(home).running
        for _ in range(1 if signum is signal.SIGINT else 2):
            other.send_signal(signum)
        assert other.wait(WAIT_S) != 0
    assert not EmbeddedServer(home).running


def test_after_a_killed_command_the_next_command_stops_it(home: Path) -> None:
    with holder(home) as (other, _):
        other.kill()
        other.wait(WAIT_S)
    assert EmbeddedServer(home).running
    with EmbeddedServer(home):
        pass
    assert not EmbeddedServer(home).running


def test_data_survives_a_restart_and_a_kill_of_the_server_itself(home: Path) -> None:
    with EmbeddedServer(home) as server, psycopg.connect(server.url) as connection:
        connection.execute("CREATE TABLE kept AS SELECT 7 AS n")
    with EmbeddedServer(home) as server:
        postmaster = int((server.data / "postmaster.pid").read_text().split()[0])
        with psycopg.connect(server.url, autocommit=True) as witness:
            os.kill(postmaster, signal.SIGKILL)
            with pytest.raises(psycopg.OperationalError):
                list(witness.notifies(timeout=WAIT_S))
        server.start()
        with psycopg.connect(server.url) as connection:
            assert connection.execute("SELECT n FROM kept").fetchone() == (7,)


def test_a_server_that_cannot_start_quotes_its_log(home: Path) -> None:
    with EmbeddedServer(home) as server:
        settings = server.data / "postgresql.auto.conf"
    right = settings.read_text()
    settings.write_text("no_such_setting = 1\n")
    try:
        with pytest.raises(EmbeddedServerError, match="no_such_setting") as caught:
            server.start()
    finally:
        settings.write_text(right)
    assert "\n" not in str(caught.value)
    assert "--db" in str(caught.value)
    assert not server.running


def test_a_server_that_cannot_be_stopped_quotes_the_program_that_tried(home: Path) -> None:
    server = EmbeddedServer(home).start()
    process_id = server.data / "postmaster.pid"
    right = process_id.read_bytes()
    process_id.write_bytes(b"no number\n")
    with pytest.raises(
        EmbeddedServerError, match=r"did not stop: pg_ctl: invalid data in PID file"
    ):
        server.stop()
    process_id.write_bytes(right)
    assert not server.stop()


def test_a_home_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(EmbeddedServerError, match="MAPFOLD_HOME"):
        EmbeddedServer(tmp_path / "file" / "below").start()


def test_a_missing_library_is_not_taken_for_a_server_that_went_away(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAPFOLD_HOME", str(home))
    with (
        EmbeddedServer(home) as server,
        connect(server.url) as connection,
        pytest.raises(DatabaseUnavailable) as told,
        database_errors(server.url),
    ):
        connection.execute("LOAD 'no_such_library'")
    assert "could not access file" in str(told.value)
    assert "went away" not in str(told.value)
    assert "closed to the server's user" in str(told.value)


def _cut(data: Path) -> None:
    os.truncate(data / "global" / "pg_control", 100)


def _unlink_version(data: Path) -> None:
    (data / "PG_VERSION").unlink()


def _empty_lock(data: Path) -> None:
    (data / "postmaster.pid").touch()


def _foreign_line(data: Path) -> None:
    with (data / "postgresql.conf").open("a") as settings:
        settings.write("a foreign line\n")


def _remove_databases(data: Path) -> None:
    shutil.rmtree(data / "base")


def _link_to_nothing(data: Path) -> None:
    data.rename(data.with_name("moved"))
    data.symlink_to("nowhere")


def _file_instead(data: Path) -> None:
    shutil.rmtree(data)
    data.touch()


DAMAGES = (
    _unlink_version, _cut, _empty_lock, _foreign_line, _remove_databases, _link_to_nothing,
    _file_instead,
)  # fmt: skip


@pytest.mark.seconds
@pytest.mark.parametrize("damage", mostly_slow(DAMAGES))
def test_damaged_data_names_db_reset_which_makes_it_usable(
    tmp_path: Path, damage: Callable[[Path], None]
) -> None:
    with tempfile.TemporaryDirectory(prefix="mapfold-test-home-") as folder:
        mapfold = Commands.in_folder(tmp_path, MAPFOLD_HOME=folder)
        log = write_log(tmp_path / "log", walk(10))
        data = furnish(Path(folder)) / "pg"
        with EmbeddedServer(Path(folder)):
            pass
        damage(data)
        said = mapfold("replay", log, code=1).err
        assert "run `mapfold db reset`" in said
        assert "then `mapfold replay " in said
        done = mapfold("db", "reset", "--json").json
        assert done == {"data": str(data), "aside": f"{data}.aside-1"}
        assert os.path.lexists(done["aside"])
        assert "10 events" in mapfold("replay", log).err
        assert not EmbeddedServer(Path(folder)).running


@pytest.mark.slow
def test_reset_stops_a_kept_server_whose_lock_file_is_damaged(home: Path) -> None:
    server = EmbeddedServer(home).start(keep=True)
    server.stop()
    process = int((server.data / "postmaster.pid").read_text().split()[0])
    ended = os.pidfd_open(process)
    try:
        (server.data / "postmaster.pid").write_bytes(b"no number\n")
        aside = server.reset()
        assert select.select([ended], [], [], WAIT_S)[0]
    finally:
        os.close(ended)
    assert aside == home / "pg.aside-1"
    shutil.rmtree(server.data)
    aside.rename(server.data)  # as the other tests of this module go on with it
    (server.data / "postmaster.pid").unlink(missing_ok=True)


@pytest.mark.slow
def test_a_server_that_damaged_data_keeps_in_recovery_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("projections.postgres.data_folder.STOP_SECONDS", 5)
    with tempfile.TemporaryDirectory(prefix="mapfold-test-home-") as folder:
        data = furnish(Path(folder)) / "pg"
        with EmbeddedServer(Path(folder)):
            pass
        (data / "global" / "pg_filenode.map").unlink()
        with EmbeddedServer(Path(folder)) as server:
            ended = os.pidfd_open(int((data / "postmaster.pid").read_text().split()[0]))
            with pytest.raises(psycopg.OperationalError):
                psycopg.connect(server.url)
        assert select.select([ended], [], [], 0)[0]
        os.close(ended)
        assert server.reset() == data.with_name("pg.aside-1")


def test_reset_is_refused_while_another_command_uses_the_server(home: Path) -> None:
    with holder(home) as (other, _):
        with pytest.raises(EmbeddedServerError, match="another command uses the server"):
            EmbeddedServer(home).reset()
        assert answers(EmbeddedServer(home))
        assert other.poll() is None


def test_a_lock_file_that_names_another_process_does_not_hinder_a_start(home: Path) -> None:
    """As after a crash of the machine, when another process of the same user has that number."""
    with EmbeddedServer(home) as server:
        lock = server.data / "postmaster.pid"
        left = lock.read_text().splitlines()
        owner = server.data.stat().st_uid
    other = subprocess.Popen(["sleep", str(WAIT_S)], cwd="/", user=owner)
    try:
        lock.write_text("\n".join([str(other.pid), *left[1:]]) + "\n")
        with EmbeddedServer(home) as again:
            assert answers(again)
        assert other.poll() is None
    finally:
        other.kill()
        other.wait(WAIT_S)
