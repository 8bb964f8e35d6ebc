"""`mapfold fleet` on a few sites with a real server."""

import json
import os
import pickle
import shlex
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import pytest
from psycopg import sql
from psycopg.conninfo import conninfo_to_dict

from projections.adapters.fleet.engines import Ended, Progress, Task
from projections.adapters.fleet.site_databases import ask_sites, exists
from projections.adapters.fleet.site_tasks import ChosenSettings, ReplayRequest, replay_site
from projections.adapters.fleet.sites import Site
from projections.localize.relocalize import read_question
from projections.postgres.connection import Targets, connect
from projections.postgres.embedded import EmbeddedServer
from tests.integration.test_time_travel_commands import InProcess
from tests.property.test_align import HERE, in_frame
from tests.support.commands import Commands
from tests.support.fleets import extend, fleet_databases, write_sites, wrong_rows
from tests.support.logs import append_raw, bridge, simulated, walk, write_log
from tests.support.servers import furnish
from tests.support.thorough import THOROUGH

EVENTS = 30  # of each site
NAMES = ['a\'; DROP "x" %s', "büro", "lab"]


class OneProcess:
    """An engine that runs the tasks in this process, where a worker would take a second to start.

    Requests and results are pickled, as between processes.
    """

    def run(
        self, task: Task, requests: Sequence[Any], progress: Progress | None = None
    ) -> Iterator[Ended]:
        for index, request in enumerate(requests):
            result = task(pickle.loads(pickle.dumps(request)), progress or (lambda _: None))
            yield Ended(index, pickle.loads(pickle.dumps(result)), None, 1)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Fleet:
    """Three sites in a folder, replayed once."""

    def __init__(self, folder: Path, server: EmbeddedServer, template: str) -> None:
        self.sites, self.server, self.template = folder / "sites", server, template
        self.run = Commands.in_folder(folder, MAPFOLD_DB=template)
        write_sites(self.sites, NAMES, EVENTS)
        self.first = self.run("fleet", "replay", self.sites, "--jobs", "1", "--json")

    def url(self, name: str) -> str:
        """Of one site's database."""
        dbname = str(conninfo_to_dict(self.template)["dbname"]).replace("{site}", name)
        return self.server.url_of(dbname)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, pg_server: EmbeddedServer) -> Iterator[Fleet]:
    with fleet_databases(pg_server) as template:
        yield Fleet(tmp_path_factory.mktemp("fleet"), pg_server, template)


@pytest.fixture
def in_process(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> InProcess:
    """Runs commands, and the tasks of sites that they start, in this process.

    Under scripts/test_slow workers of `LocalPool` run the tasks.
    """
    if not THOROUGH:
        monkeypatch.setattr(
            "projections.surfaces.cli.fleet_options.LocalPool", lambda _: OneProcess()
        )
    monkeypatch.setenv("MAPFOLD_DB", fleet.template)
    return InProcess(fleet.sites.parent, capfd)


@pytest.mark.seconds
def test_a_replay_makes_the_database_of_each_site_equal_to_its_log(fleet: Fleet) -> None:
    first = fleet.first.json
    assert [entry["site"] for entry in first["sites"]] == NAMES
    assert (first["rebuilt"], first["up_to_date"], first["failed"]) == (3, 0, 0)
    for entry in first["sites"]:
        assert entry["outcome"] == "rebuilt"
        assert entry["attempts"] == 1
        assert entry["report"]["events"] == entry["events"] == EVENTS
        assert wrong_rows(fleet.sites / entry["site"], fleet.url(entry["site"])) == 0
    single = fleet.run("replay", fleet.sites / "lab", "--db", fleet.url("lab"), "--json").json
    report = first["sites"][2]["report"]
    assert {**single, "fold_s": 0, "total_s": 0} == {**report, "fold_s": 0, "total_s": 0}
    assert "3 sites: 3 rebuilt, 0 up to date" in fleet.first.err


@pytest.mark.seconds
def test_what_is_up_to_date_is_skipped_and_what_fails_is_named(
    fleet: Fleet, in_process: InProcess, tmp_path: Path
) -> None:
    sites = tmp_path / "sites"
    sites.mkdir()
    for name in NAMES[1:]:
        (sites / name).symlink_to(fleet.sites / name)
    (sites / "bad").mkdir()
    (sites / "bad" / "00000000000000000000.mcap").write_bytes(b"no segment")

    said = in_process("fleet", "replay", sites, "--jobs", "1", "--json", code=3)

    outcomes = {entry["site"]: entry["outcome"] for entry in said.json["sites"]}
    assert outcomes == {"bad": "failed", "büro": "up_to_date", "lab": "up_to_date"}
    assert "3 sites: 0 rebuilt, 2 up to date, 1 failed\nfailed: bad: " in said.err
    bad = said.json["sites"][0]
    assert bad["report"] is None
    assert str(sites / "bad") in bad["error"]
    with pytest.raises(Exception, match="does not exist"), connect(fleet.url("bad")):
        pass


@pytest.mark.seconds
@pytest.mark.slow
def test_the_map_of_another_log_is_replaced_only_when_told(pg_url: str, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(10))
    site = ReplayRequest(Site("büro", log), Targets(pg_url, pg_url))

    def outcome(request: ReplayRequest) -> str:
        done = replay_site(request, lambda _: None)
        assert (done.error is None) == (done.outcome != "failed")
        return done.error or done.outcome

    assert outcome(site) == "rebuilt"
    extend(log, 0, 5, first=10)
    assert outcome(site) == "rebuilt"
    assert outcome(site) == "up_to_date"
    assert outcome(replace(site, again=True)) == "rebuilt"
    # with other settings it is another map of the same log
    other = replace(site, settings=ChosenSettings(None, ("eps_m=0.5",)))
    assert outcome(other) == "rebuilt"
    log.rename(tmp_path / "before")
    write_log(log, walk(20, seed=9))
    for refused in (site, replace(site, again=True)):
        assert "made from another log" in outcome(refused)
        assert "--replace rebuilds it" in outcome(refused)
    assert outcome(replace(site, replace=True)) == "rebuilt"
    # a copy of the log that went on with other events has the same id
    shutil.copytree(log, tmp_path / "copy")
    extend(log, 0, 1, first=20)
    assert outcome(site) == "rebuilt"
    extend(tmp_path / "copy", 5, 1, first=20)
    copy = replace(site, site=Site("büro", tmp_path / "copy"))
    assert "is not the one that is in the graph" in outcome(copy)


def test_advised_commands_are_for_the_site(pg_url: str, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(3))
    append_raw(log, b"{}")
    done = replay_site(ReplayRequest(Site("a", log), Targets(pg_url, pg_url)), print)
    assert done.error is not None
    before, tail = done.error.partition("to leave it out run: ")[2].split(" && ")
    for command in (before, tail):
        assert shlex.split(command)[-2:] == ["--db", pg_url]


def test_status_is_a_table_of_all_sites(
    fleet: Fleet, in_process: InProcess, tmp_path: Path
) -> None:
    listed = tmp_path / "list"
    more = write_log(tmp_path / "more", bridge())
    lines = [f"lab {fleet.sites / 'lab'}", f"new {more}", f"gone {tmp_path / 'gone'}"]
    listed.write_text("\n".join(lines))

    said = fleet.run("fleet", "status", listed, "--jobs", "1", code=3)
    head, *rows = [line.split() for line in said.out.splitlines()]
    assert head[:3] == ["site", "state", "events"]
    assert rows[0][:3] == ["lab", "ok", str(EVENTS)]
    assert rows[0][-2:] == ["idle", "idle"]
    assert rows[1][:3] == ["new", "findings", "20"]
    assert rows[1][-2:] == ["missing", "missing"]
    assert rows[2][:2] == ["gone", "failed"]
    assert f"failed: gone: no log at {tmp_path / 'gone'}" in said.err

    document = in_process("fleet", "status", listed, "--jobs", "1", "--json", code=3).json
    assert document["ok"] is False
    lab, new, gone = document["sites"]
    single = fleet.run("status", fleet.sites / "lab", "--db", fleet.url("lab"), "--json").json
    info = fleet.run("log", "info", fleet.sites / "lab", "--json").json
    assert _without_ages(lab) == _without_ages(
        {"site": "lab", "path": str(fleet.sites / "lab"), "ok": True, "error": None, "info": info}
        | single
    )
    assert new["sinks"]["graph"]["condition"] == "missing"
    assert gone["sinks"] is None


def _without_ages(entry: dict[str, Any]) -> dict[str, Any]:
    sinks = {
        name: {key: value for key, value in sink.items() if not key.endswith("_age_s")}
        for name, sink in entry["sinks"].items()
    }
    return entry | {"sinks": sinks}


def test_verify_reads_all_logs(fleet: Fleet, in_process: InProcess, tmp_path: Path) -> None:
    said = fleet.run("fleet", "verify", fleet.sites, "--jobs", "1")
    assert f"3 sites: {3 * EVENTS} events," in said.err
    assert said.err.endswith(": all good\n")

    damaged = write_log(tmp_path / "sites" / "damaged", walk(10))
    segment = next(damaged.glob("*.mcap"))
    data = bytearray(segment.read_bytes())
    data[len(data) // 2] ^= 1
    segment.write_bytes(bytes(data))
    found = in_process("fleet", "verify", tmp_path / "sites", "--json", code=3)
    [entry] = found.json["sites"]
    assert (entry["site"], entry["sound"], entry["error"]) == ("damaged", False, None)
    assert entry["report"] == fleet.run("log", "verify", damaged, "--json", code=3).json


def test_relocalize_ranks_the_sites(fleet: Fleet, tmp_path: Path) -> None:
    keyframe = next(k for k in walk(EVENTS, seed=2) if len(k["detections"]) == 2)
    query = tmp_path / "query.json"
    query.write_text(json.dumps(keyframe))
    lines = [f"{name} {fleet.sites / name}" for name in NAMES[1:]]
    listed = tmp_path / "list"
    listed.write_text("\n".join([*lines, f"new {fleet.sites / 'lab'}"]))

    found = fleet.run("fleet", "relocalize", listed, query, "--json", code=3)
    sites = {entry["site"]: entry for entry in found.json["sites"]}
    assert found.json["site"] == found.json["sites"][0]["site"] == "lab"
    assert sites.keys() == {"büro", "lab"}
    total = found.json["none"] + sum(entry["probability"] for entry in sites.values())
    assert total == pytest.approx(1.0)
    assert found.json["not_asked"].keys() == {"new"}
    alone = fleet.run("relocalize", query, "--db", fleet.url("lab"), "--json").json
    assert {k: v for k, v in sites["lab"].items() if k not in ("site", "probability")} == alone

    listed.write_text(lines[0].replace(NAMES[1], "new"))
    text = fleet.run("fleet", "relocalize", listed, query, code=3)
    assert text.out == "no site could be asked\n"

    absent = tmp_path / "absent"
    listed.write_text(f"new {absent}")
    text = fleet.run("fleet", "relocalize", listed, query, code=3)
    assert f"not asked: new: no log at {absent}; " in text.err

    text = fleet.run("fleet", "relocalize", fleet.sites / "..", query, code=None)
    assert text.code == 2  # the folder above the sites has no log in its subfolders
    text = fleet.run("fleet", "relocalize", fleet.sites, query)
    assert text.out.startswith("lab (probability ")
    assert "none of them" in text.out.splitlines()[-1]


def test_url_is_that_of_the_site(fleet: Fleet) -> None:
    assert fleet.run("fleet", "url", fleet.sites, "lab").out == fleet.url("lab") + "\n"
    refused = fleet.run("fleet", "url", fleet.sites, "nowhere", code=2)
    assert f"no site 'nowhere'; there are {', '.join(NAMES)}" in refused.err


def test_what_cannot_be_is_refused_before_anything_is_done(fleet: Fleet) -> None:
    for options, wrong in (
        (["--engine", "ray"], "--engine ray: there are local and dask://HOST:PORT"),
        (["--engine", "dask://h:1", "--jobs", "2"], "--jobs is for --engine local"),
        (["--db", "postgresql://h/maps"], "no {site} in it"),
        (["--set", "eps_m=-1"], "--set eps_m=-1"),
    ):
        assert wrong in fleet.run("fleet", "replay", fleet.sites, *options, code=2).err


def test_logs_that_cannot_be_compared_are_named(in_process: InProcess, tmp_path: Path) -> None:
    sites = write_sites(tmp_path / "sites", ["a", "b"], 5)
    (sites / "bad").mkdir()
    (sites / "bad" / "00000000000000000000.mcap").write_bytes(b"no segment")
    said = in_process("fleet", "align", sites, "--json", code=3).json
    assert said["buildings"] == []
    assert [each["site"] for each in said["alone"]] == ["a", "b"]
    assert said["failed"].keys() == {"bad"}
    assert "is no MCAP file" in said["failed"]["bad"]


@pytest.mark.slow
def test_logs_of_one_building_are_found_in_any_frame(in_process: InProcess, tmp_path: Path) -> None:
    camera = {"hfov_deg": 69.4, "width_px": 640, "height_px": 400}
    for name, seed, run, frame in (
        ("a", 7, "a", HERE),
        ("b", 7, "b", (40.0, -7.0, 2.1)),
        ("other", 3, "a", HERE),
    ):
        seen = simulated(seed, run).envelopes[::2]
        write_log(
            tmp_path / "sites" / name, [in_frame(e, frame) | {"camera": camera} for e in seen]
        )
    said = in_process("fleet", "align", tmp_path / "sites", "--json").json
    assert [each["sites"] for each in said["buildings"]] == [["a", "b"]]
    assert [each["site"] for each in said["alone"]] == ["other"]
    text = in_process("fleet", "align", tmp_path / "sites").out
    assert [line.split()[:2] for line in text.splitlines()[1:4]] == [
        ["1", "a"],
        ["1", "b"],
        ["-", "other"],
    ]


def test_a_server_that_is_not_there_is_said_once(
    fleet: Fleet, in_process: InProcess, tmp_path: Path
) -> None:
    sites = write_sites(tmp_path / "sites", ["a", "b"], 5)
    nowhere = f"postgresql:///{{site}}?host={tmp_path}"
    said = fleet.run("fleet", "replay", sites, "--db", nowhere, code=1)
    assert said.err.startswith("mapfold: database a at ")
    assert len(said.err.splitlines()) == 1
    status = in_process("fleet", "status", sites, "--db", nowhere, "--json", code=3).json
    assert [site["sinks"]["graph"]["condition"] for site in status["sites"]] == ["unreachable"] * 2


def test_a_name_of_any_letters_is_asked_for_under_any_encoding(
    pg_server: EmbeddedServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PGCLIENTENCODING", "LATIN1")
    assert exists(pg_server.url_of("東京")) is False


@pytest.mark.slow
def test_a_site_whose_server_refuses_the_list_of_databases_is_not_asked(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="mapfold-test-home-") as home:
        furnish(Path(home))
        with EmbeddedServer(Path(home)) as server:
            with connect(server.url, autocommit=True) as connection:
                connection.execute("CREATE ROLE asker LOGIN")
                connection.execute("REVOKE SELECT ON pg_catalog.pg_database FROM PUBLIC")
            url = server.url_of("a").replace("://postgres@", "://asker@")
            question = read_question({"crops": [{"class": "chair"}]})
            sites, databases = [Site("a", tmp_path)], {"a": Targets(url, url)}
            answer = ask_sites(sites, databases, question, top=1, camera=None, jobs=1)
    assert "permission denied" in answer.not_asked["a"]


@pytest.mark.seconds
def test_a_user_who_may_not_create_databases_is_told_what_to_do(
    pg_server: EmbeddedServer, server_roles: None, tmp_path: Path
) -> None:
    if "://postgres@" not in pg_server.url:
        pytest.skip("the server of MAPFOLD_TEST_DB may want a password")
    log = write_log(tmp_path / "log", [])
    user = f"fleet_{os.getpid()}"
    with connect(pg_server.url, autocommit=True) as connection:
        connection.execute(sql.SQL("CREATE ROLE {} LOGIN").format(sql.Identifier(user)))
        try:
            url = pg_server.url_of(f"{user}_a").replace("://postgres@", f"://{user}@")
            done = replay_site(ReplayRequest(Site("a", log), Targets(url, url)), print)
        finally:
            connection.execute(sql.SQL("DROP ROLE {}").format(sql.Identifier(user)))
    assert done.error is not None
    assert f"it does not exist, and user {user} may not create it" in done.error
    assert f"createdb -E UTF8 -T template0 -O {user} {user}_a" in done.error
