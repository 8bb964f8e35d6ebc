"""replay, tail, status and db as a person runs them: against an embedded server of their own where
its start and stop matter, else against the one that all tests share."""

import contextlib
import os
import pty
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from projections.postgres.embedded import EmbeddedServer
from tests.support.commands import PROGRAM, Commands
from tests.support.envelopes import MODEL, detection, envelope
from tests.support.logs import append_raw, walk, write_log
from tests.support.servers import furnish
from tests.support.thorough import mostly_slow

WAIT_S = 60
REPLAYS = "SELECT count(*) FROM pg_stat_activity WHERE application_name = 'mapfold replay'"


@pytest.fixture
def folder() -> Iterator[Path]:
    made = Path(tempfile.mkdtemp(prefix="mapfold-test-commands-"))
    yield made
    shutil.rmtree(made, ignore_errors=True)


@pytest.fixture
def own_server(folder: Path) -> Iterator[Commands]:
    """Commands that start an embedded server and stop it."""
    commands = Commands.in_folder(folder)
    furnish(commands.home)
    yield commands
    server(commands).stop(discard_keep=True)


@pytest.fixture
def mapfold(folder: Path, pg_url: str) -> Commands:
    """Commands on a fresh database of the server that all tests share."""
    return Commands.in_folder(folder, MAPFOLD_DB=pg_url)


@pytest.fixture
def log(folder: Path) -> Path:
    return write_log(folder / "log", walk(40))


def server(commands: Commands) -> EmbeddedServer:
    return EmbeddedServer(commands.home)


def test_replay_tail_status_and_check(own_server: Commands, log: Path) -> None:
    with server(own_server):  # so that not each command starts it
        assert own_server("status", log, code=3).out.count("missing") == 2
        replayed = own_server("replay", log, "--until", "run-a:29", "--json").json
        assert replayed["events"] == 30
        status = own_server("status", log, "--json", code=3).json
        assert status["sinks"]["graph"]["condition"] == "behind"
        assert status["sinks"]["graph"]["lag"] == 10
        tailed = own_server("tail", log, "--once", "--json").json
        assert (tailed["events"], tailed["next_offset"]) == (10, 40)
        status = own_server("status", log, "--json").json
        assert [s["condition"] for s in status["sinks"].values()] == ["idle", "idle"]
        assert status["sinks"]["graph"]["versions"].keys() == {"postgresql", "age", "vector"}
        checked = own_server("db", "check", log, "--json").json
        assert [s["differing"] for s in checked["sinks"]] == [0, 0]
        assert (
            own_server("state", log, "--digest").out.strip()
            == own_server("replay", log, "--json").json["digest"]
        )
    assert not server(own_server).running


def test_check_and_repair(own_server: Commands, log: Path) -> None:
    own_server("db", "start")
    own_server("replay", log)
    with psycopg.connect(own_server("db", "url").out.strip()) as connection:
        connection.execute("DELETE FROM detection_embeddings WHERE det_pk = 1")
    found = own_server("db", "check", log, code=3)
    assert "missing detection_embeddings 1" in found.out
    assert "db check --repair" in found.err
    assert "rebuilt" in own_server("db", "check", log, "--repair", code=3).err
    own_server("db", "check", log)
    own_server("db", "stop")
    assert not server(own_server).running


def test_status_and_check_try_a_question(mapfold: Commands, log: Path, pg_url: str) -> None:
    assert mapfold("replay", log).code == 0
    with psycopg.connect(pg_url) as connection:
        connection.execute(
            "UPDATE mapfold.checkpoint SET settings = %s WHERE sink = 'graph'", ['{"no_such": 1}']
        )
    for command in (["status", log], ["db", "check", log]):
        assert "questions cannot be answered: database" in mapfold(*command, code=3).out
        assert "question_error" in mapfold(*command, "--json", code=3).json


def test_parked_events_are_findings(mapfold: Commands, log: Path) -> None:
    append_raw(log, b"neither fish nor fowl")
    assert "cannot be folded" in mapfold("replay", log, code=1).err
    assert "parked: offset 40" in mapfold("tail", log, "--once", code=3).err
    assert "parked: offset 40" in mapfold("status", log, code=3).out


@pytest.mark.slow
def test_what_a_replay_advises_for_an_event_that_cannot_be_folded_works(
    mapfold: Commands, log: Path
) -> None:
    append_raw(log, b"not an envelope")
    write_log(log, walk(5, run_id="after"))
    said = mapfold("replay", log, "--set", "eps_m=1.0", code=1).err
    assert "offset 40 cannot be folded" in said
    assert "the databases stay as they were" in said
    first, then = said.strip().rpartition("run: ")[2].split(" && ")
    mapfold(*shlex.split(first)[1:])
    mapfold(*shlex.split(then)[1:], "--once", code=3)
    status = mapfold("status", log, "--set", "eps_m=1.0", code=3)
    assert status.out.count("at offset 46, 0 behind") == 2
    assert status.out.count("parked: offset 40: ") == 2


def test_other_settings_are_refused_with_the_command_to_run(mapfold: Commands, log: Path) -> None:
    mapfold("replay", log)
    said = mapfold("tail", log, "--once", "--set", "eps_m=2", code=1)
    assert "eps_m=1.5 there, 2.0 here" in said.err
    assert f"mapfold replay {log}" in said.err
    assert said.err.count("\n") == 1


def advised(said: str) -> list[str]:
    """The arguments of the command that a message tells to run."""
    return shlex.split(said[said.rindex("run: mapfold ") :].splitlines()[0])[2:]


@pytest.mark.slow
def test_what_status_advises_works(mapfold: Commands, log: Path) -> None:
    own = ("--set", "eps_m=0.75", "--set", "min_samples=4")
    assert advised(mapfold("status", log, *own, code=3).err)[2:] == list(own)
    mapfold("replay", log, *own, "--until", "20")
    status = mapfold("status", log, *own, code=3)
    assert mapfold(*advised(status.err), "--once").code == 0
    mapfold("status", log, *own)


def test_a_refusal_names_the_settings_that_fit(mapfold: Commands, log: Path) -> None:
    mapfold("replay", log, "--set", "eps_m=0.75")
    said = mapfold("tail", log, "--once", "--set", "min_samples=4", code=1).err
    assert "the graph there was made with other settings" in said
    fitting = said.partition("to go on with them give ")[2].partition(" instead;")[0]
    assert fitting == "--set eps_m=0.75 --set min_samples=3"
    mapfold("tail", log, "--once", *fitting.split())
    assert advised(said) == ["replay", str(log), "--set", "min_samples=4"]


@pytest.mark.slow
def test_a_refusal_names_settings_of_groups_that_fit(mapfold: Commands, log: Path) -> None:
    """Also from a map whose settings are older than the groups, and back to it."""
    own = ("--set", "camera.hfov_deg=90.0", "--set", "evidence.sizes_m.potted plant=0.4")
    mapfold("replay", log)
    said = mapfold("tail", log, "--once", *own, code=1).err
    assert (
        "(camera.hfov_deg=None there, 90.0 here, "
        "evidence.sizes_m.potted plant=None there, 0.4 here)" in said
    )
    fitting = said.partition("to go on with them give ")[2].partition(" instead;")[0]
    mapfold("tail", log, "--once", *shlex.split(fitting))
    assert advised(said) == ["replay", str(log), *own]
    mapfold(*advised(said))
    said = mapfold("tail", log, "--once", code=1).err
    fitting = said.partition("to go on with them give ")[2].partition(" instead;")[0]
    assert shlex.split(fitting) == list(own)
    mapfold("tail", log, "--once", *own)


@pytest.mark.slow
def test_another_log_has_no_lag(mapfold: Commands, log: Path) -> None:
    mapfold("replay", log)
    other = write_log(mapfold.folder / "other", walk(5))
    said = mapfold("status", other, code=3)
    assert "graph    other at offset 40 · " in said.out
    assert "behind" not in said.out
    assert "the graph there was made from log" in said.err
    assert "the vectors there were made from log" in said.err


@pytest.mark.slow
def test_a_replay_prints_what_it_left_out(mapfold: Commands) -> None:
    first = envelope(0, detections=[detection("cup", [1.0] * 8)])
    others = walk(6, first=1, dim=16, detections=3)
    again = {**others[0], "map_x": 77.0}
    reused = envelope(90, detections=[detection("cup", det_id="run-a_kf0_d0")])
    log = write_log(mapfold.folder / "mixed", [first, *others, first, again, reused])
    many = sum("embedding" in d for document in others for d in document["detections"])
    line = mapfold("replay", log).err.splitlines()[-1]
    assert line.startswith("left out: 1 keyframe that came twice; 1 keyframe that came again with")
    assert "1 observation with the det_id of an earlier keyframe" in line
    assert f"{many} embeddings of another space: the map's are of {MODEL} with 8 dimensions" in line
    assert f"is of {MODEL} with 16 dimensions" in line
    assert advised(line) == ["replay", str(log), "--set", "embedding_dim=16"]
    line = mapfold(*advised(line)).err.splitlines()[-1]
    assert "1 embedding of another space" in line
    assert f"{MODEL} with 16 dimensions, as the settings say, but" in line
    document = mapfold("replay", log, "--set", "embedding_dim=3", "--json").json
    assert document["foreign"]["map_dim"] is None
    assert document["counts"]["foreign_embeddings"] == many + 1


@pytest.mark.slow
def test_a_complete_replay_prints_no_left_out_line(mapfold: Commands, log: Path) -> None:
    assert "left out" not in mapfold("replay", log).err


@pytest.mark.slow
def test_db_stop_says_whether_anything_ran(own_server: Commands) -> None:
    assert own_server("db", "stop").err == "it was not running\n"
    own_server("db", "start")
    assert own_server("db", "stop").err == "stopped\n"


@pytest.mark.slow
def test_a_live_tail_prints_when_it_has_caught_up(mapfold: Commands, log: Path) -> None:
    running = subprocess.Popen(
        [str(PROGRAM), "tail", str(log)], env=dict(mapfold.env), cwd=mapfold.folder,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert running.stderr is not None
        assert running.stderr.readline() == f"following {log} from offset 40 on; Ctrl-C ends it\n"
    finally:
        running.terminate()
        _, rest = running.communicate(timeout=WAIT_S)
    assert "the databases are at offset 40" in rest


def read_screen(screen: int) -> str:
    """All that a program shows on its terminal until it has ended."""
    shown = b""
    # On Linux a terminal that no process has open any more is an error to read from.
    with os.fdopen(screen, "rb", buffering=0) as stream, contextlib.suppress(OSError):
        while part := stream.read(4096):
            shown += part
    return shown.decode()


@pytest.mark.slow
def test_a_tail_that_catches_up_shows_a_bar_on_a_terminal(mapfold: Commands, log: Path) -> None:
    ours, theirs = pty.openpty()
    running = subprocess.Popen(
        [str(PROGRAM), "tail", str(log), "--once"],
        env={**mapfold.env, "TERM": "xterm"}, cwd=mapfold.folder, stderr=theirs,
    )  # fmt: skip
    os.close(theirs)
    shown = read_screen(ours)
    assert running.wait(WAIT_S) == 0, shown
    assert "catching up" in shown
    assert "40/40" in shown


def test_roles_are_sql(mapfold: Commands) -> None:
    assert "GRANT SELECT ON ALL TABLES IN SCHEMA semantic_map" in mapfold("db", "roles").out
    assert "semantic_map" not in mapfold("db", "roles", "--only", "vectors").out


@pytest.mark.parametrize("signum", mostly_slow([signal.SIGTERM, signal.SIGINT]))
def test_a_signal_ends_a_live_tail_after_its_batch_and_leaves_no_server(
    own_server: Commands, log: Path, signum: signal.Signals
) -> None:
    running = subprocess.Popen(
        [str(PROGRAM), "tail", str(log), "--metrics", "0"],
        env=dict(own_server.env),
        cwd=own_server.folder,
        stderr=subprocess.PIPE,
        text=True,
    )
    watchdog = threading.Timer(WAIT_S, running.kill)
    watchdog.start()
    try:
        assert running.stderr is not None
        assert "metrics on http://127.0.0.1:" in running.stderr.readline()
        running.send_signal(signum)
        told = running.stderr.read()
        assert running.wait(WAIT_S) == 0, told
    finally:
        watchdog.cancel()
        running.kill()
        running.wait()
        if running.stderr is not None:
            running.stderr.close()
    assert "the databases are at offset" in told
    assert not server(own_server).running


@pytest.mark.slow
def test_sigterm_in_the_middle_of_a_replay_leaves_no_server_and_the_old_map(
    own_server: Commands, log: Path
) -> None:
    own_server("replay", log, "--until", "20")
    big = write_log(own_server.folder / "log", walk(4000, first=40, detections=4))
    running = subprocess.Popen(
        [str(PROGRAM), "replay", str(big)], env=dict(own_server.env), cwd=own_server.folder,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        with server(own_server) as shared:  # the server is up once this returns
            with psycopg.connect(shared.url, autocommit=True) as witness:
                while witness.execute(REPLAYS).fetchone() == (0,):
                    assert running.poll() is None
            os.kill(running.pid, signal.SIGTERM)
            assert running.wait(WAIT_S) == 128 + signal.SIGTERM
    finally:
        running.kill()
        running.wait()
    assert not server(own_server).running
    status = own_server("status", log, "--json", code=3).json
    assert status["sinks"]["graph"]["next_offset"] == 20
