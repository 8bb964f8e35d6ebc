"""A tail that meets commands comes to the rows of a fresh replay, and names places at once."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import psycopg
import pytest

from eventsrc.envelope.commands import Command, UseSettings
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader
from projections.fold.map_errors import ProjectionMismatch
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.postgres import rebuild, tail
from projections.postgres.check import check
from projections.postgres.connection import Targets
from projections.postgres.status import Status, projection_status
from projections.surfaces.cli.db import _sink_line
from tests.support.commands import Commands
from tests.support.logs import (
    append_command,
    command,
    forget_keyframes,
    forget_run,
    join_frames,
    keep_apart,
    name_place,
    undo,
    walk,
    write_log,
)
from tests.support.rows import (
    LOG_LENGTH,
    SETTINGS,
    WAIT_S,
    all_rows,
    fresh_rows,
    graph_rows,
    parsed,
    tailing,
    three_rooms,
)
from tests.support.thorough import rounds


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return three_rooms(tmp_path)


@pytest.fixture(params=["one_database", "two_databases"][: rounds(2, 1)])
def targets(request: pytest.FixtureRequest) -> Targets:
    found: Targets = request.getfixturevalue(request.param)
    return found


def digests(targets: Targets) -> set[str | None]:
    found = set()
    for url in {targets.graph_url, targets.vector_url}:
        with psycopg.connect(url) as connection:
            found.update(connection.execute("SELECT digest FROM mapfold.checkpoint").fetchall())
    return {digest for (digest,) in found}


def names(targets: Targets) -> dict[str, str]:
    return {
        properties["place_id"]: properties["name"]
        for _, properties in parsed(graph_rows(targets.graph_url))["Place"]
        if "name" in properties
    }


@pytest.mark.parametrize(
    "commands",
    [
        pytest.param([forget_run("run-b")], id="forget-run", marks=pytest.mark.slow),
        pytest.param([forget_keyframes(5, 40)], id="forget-keyframes", marks=pytest.mark.slow),
        pytest.param([name_place(3, "kitchen")], id="name", marks=pytest.mark.slow),
        pytest.param([keep_apart(0, 1), name_place(0, "hall")], id="keep-apart"),
    ],
)
def test_commands_come_to_the_rows_of_a_fresh_replay(
    log: Path, targets: Targets, third_database: Targets, commands: list[Command]
) -> None:
    tail(log, targets, SETTINGS, once=True)
    before = all_rows(targets)
    for given in commands:
        append_command(log, given)
    write_log(log, walk(10, seed=5, run_id="run-d"))
    report = tail(log, targets, SETTINGS, once=True)
    assert all_rows(targets) == fresh_rows(log, third_database)
    assert report.refolds == (0 if commands[0].kind == "name-place" else 1)
    assert tail(log, targets, SETTINGS, once=True).events == 0
    assert [c.sound for c in check(log, targets, SETTINGS)] == [True, True]
    for given in commands:
        append_command(log, undo(given))
    append_command(log, forget_run("run-d"))
    tail(log, targets, SETTINGS, once=True)
    assert all_rows(targets) == before


def test_frames_are_joined_to_the_rows_of_a_fresh_replay(
    tmp_path: Path, one_database: Targets, third_database: Targets
) -> None:
    """Held apart before, as on a floor of its own; and later runs in the frame are joined too."""
    log, away = tmp_path / "log", {"frame": "b"}
    there = [each | away for each in walk(30, seed=3, run_id="run-c")]
    write_log(log, [each | {"frame": "a"} for each in walk(30)] + there)
    tail(log, one_database, SETTINGS, once=True)
    before = all_rows(one_database)
    assert before == fresh_rows(log, third_database)
    assert [each for _, each in parsed(before[0])["Floor"]] == [{"floor": "frame b"}]
    given = join_frames("b", "a", dx=0.25, dyaw=0.1)
    append_command(log, given)
    write_log(log, [each | away for each in walk(10, seed=5, run_id="run-d")])
    assert tail(log, one_database, SETTINGS, once=True).refolds == 1
    rows = all_rows(one_database)
    assert rows == fresh_rows(log, third_database)
    keyframes = [each for _, each in parsed(rows[0])["Keyframe"]]
    joined = [each["frame_joined"] for each in keyframes if "frame" in each]  # of those with a pose
    assert all(joined)
    assert 30 < len(joined) <= 40
    assert rows[0]["Floor"] == []
    append_command(log, undo(given))
    append_command(log, forget_run("run-d"))
    tail(log, one_database, SETTINGS, once=True)
    assert all_rows(one_database) == before


def test_a_batch_may_end_between_a_command_and_its_undo(
    log: Path, one_database: Targets, third_database: Targets
) -> None:
    tail(log, one_database, SETTINGS, once=True)
    given = forget_run("run-b")
    for each in (given, name_place(3, "kitchen"), undo(given)):
        append_command(log, each)
    assert tail(log, one_database, SETTINGS, once=True, batch_events=1).refolds == 0
    assert all_rows(one_database) == fresh_rows(log, third_database)


@pytest.mark.slow
def test_an_undone_command_gives_the_digest_of_before(log: Path, one_database: Targets) -> None:
    rebuild(log, one_database, SETTINGS)
    (digest,) = digests(one_database)
    given = forget_run("run-b")
    append_command(log, given)
    tail(log, one_database, SETTINGS, once=True)
    (other,) = digests(one_database)
    append_command(log, undo(given))
    tail(log, one_database, SETTINGS, once=True)
    assert digests(one_database) == {digest} != {other}
    with LogReader(log) as reader:
        assert map_digest(fold_log(reader, SETTINGS)[1]) == digest


@pytest.mark.slow
def test_a_live_tail_names_places_and_refolds(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    with tailing(log, targets) as (progress, running):
        assert progress.wait(Offset(LOG_LENGTH), WAIT_S)
        at = append_command(log, name_place(3, "kitchen"))
        assert progress.wait(Offset(at + 1), WAIT_S)
        assert set(names(targets).values()) == {"kitchen"}
        at = append_command(log, forget_run("run-b"))
        assert progress.wait(Offset(at + 1), WAIT_S)
        assert set(names(targets).values()) == {"kitchen"}
        at = append_command(log, name_place(3, "hall"))
        write_log(log, walk(10, seed=5, run_id="run-d"))
        assert progress.wait(Offset(at + 11), WAIT_S)
        assert set(names(targets).values()) == {"hall"}
    assert running.result().refolds == 1
    assert all_rows(targets) == fresh_rows(log, third_database)


@pytest.mark.slow
def test_a_fresh_tail_folds_under_the_commands_of_the_whole_log(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    append_command(log, forget_run("run-b"))
    append_command(log, name_place(3, "kitchen"))
    report = tail(log, targets, SETTINGS, once=True, batch_events=7)
    assert report.refolds == 0
    assert all_rows(targets) == fresh_rows(log, third_database)


@pytest.mark.parametrize(
    ("second", "refolds"),
    [
        pytest.param(name_place(3, "kitchen"), 1, id="a name joins", marks=pytest.mark.slow),
        pytest.param(forget_keyframes(5, 40), 1, id="another one restarts it"),
    ],
)
def test_a_command_during_a_refold_is_not_lost(
    log: Path,
    targets: Targets,
    third_database: Targets,
    monkeypatch: pytest.MonkeyPatch,
    second: Command,
    refolds: int,
) -> None:
    monkeypatch.setattr("projections.postgres.refold.TICK_EVENTS", 10)
    monkeypatch.setattr("projections.postgres.refold.LOOK_S", 0.0)
    tail(log, targets, SETTINGS, once=True)
    append_command(log, forget_run("run-b"))
    given: list[int] = []

    def give_second(done: int, _: int) -> None:
        if done >= 40 and not given:
            given.append(append_command(log, second))

    report = tail(log, targets, SETTINGS, once=True, on_refold=give_second)
    assert report.refolds == refolds
    assert all_rows(targets) == fresh_rows(log, third_database)


@pytest.mark.slow
def test_commands_that_keep_coming_do_not_keep_the_map_from_changing(
    log: Path, one_database: Targets, third_database: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("projections.postgres.refold.TICK_EVENTS", 10)
    monkeypatch.setattr("projections.postgres.refold.LOOK_S", 0.0)
    tail(log, one_database, SETTINGS, once=True)
    append_command(log, forget_run("run-b"))
    seen: list[tuple[int, int]] = []
    given: list[int] = []

    def keep_coming(done: int, total: int) -> None:
        seen.append((done, total))
        if len(given) < 20 and done >= 20:
            given.append(append_command(log, forget_keyframes(len(given), len(given))))

    report = tail(log, one_database, SETTINGS, once=True, on_refold=keep_coming)
    assert 1 <= report.refolds <= 3
    assert len(given) == 20
    assert all_rows(one_database) == fresh_rows(log, third_database)


def oid(targets: Targets) -> Any:
    with psycopg.connect(targets.vector_url) as connection:
        return connection.execute("SELECT 'detection_embeddings'::regclass::oid").fetchone()


@pytest.mark.slow
def test_corrections_of_places_keep_the_vectors(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    tail(log, targets, SETTINGS, once=True)
    table = oid(targets)
    append_command(log, keep_apart(0, 1))
    write_log(log, walk(10, seed=5, run_id="run-d"))
    assert tail(log, targets, SETTINGS, once=True).refolds == 1
    assert oid(targets) == table
    assert all_rows(targets) == fresh_rows(log, third_database)
    append_command(log, forget_run("run-b"))
    tail(log, targets, SETTINGS, once=True)
    assert oid(targets) != table


def test_settings_of_the_log_are_used_and_changed(
    log: Path, one_database: Targets, third_database: Targets
) -> None:
    def settings_of(corrections: Any) -> Settings:
        return corrections.settings or Settings()

    tail(log, one_database, settings_of, once=True)
    append_command(log, command(UseSettings, settings={"eps_m": 0.5}))
    assert tail(log, one_database, settings_of, once=True).refolds == 1
    rebuild(log, third_database, Settings(eps_m=0.5))
    assert all_rows(one_database) == all_rows(third_database)
    status = projection_status(log, one_database, settings_of)
    assert [s.condition for s in status.sinks] == ["idle", "idle"]
    assert {s.condition for s in projection_status(log, one_database, SETTINGS).sinks} == {"other"}
    with pytest.raises(ProjectionMismatch, match=r"eps_m=0.5 there, 1.5 here"):
        tail(log, one_database, SETTINGS, once=True)


@pytest.mark.slow
def test_settings_of_fusion_by_evidence_keep_the_vectors(
    log: Path, targets: Targets, third_database: Targets
) -> None:
    def settings_of(corrections: Any) -> Settings:
        return corrections.settings or Settings()

    tail(log, targets, settings_of, once=True)
    table = oid(targets)
    given: dict[str, object] = {
        "fusion": "evidence",
        "camera": {"hfov_deg": 90.0},
        "evidence": {"range_m": 1.25, "sizes_m": {"baker's rack": 1.5, "a=b.c": 0.25}},
    }
    append_command(log, command(UseSettings, settings=given))
    write_log(log, walk(10, seed=5, run_id="run-d"))
    assert tail(log, targets, settings_of, once=True).refolds == 1
    assert oid(targets) == table
    evidence = Settings.from_document(given)
    rebuild(log, third_database, evidence)
    rows = all_rows(targets)
    assert rows == all_rows(third_database)
    objects = [json.loads(row[1]) for row in rows[0]["Object"]]
    assert objects
    assert all("missing" in each for each in objects)
    assert tail(log, targets, settings_of, once=True).refolds == 0
    assert all(report.sound for report in check(log, targets, settings_of))
    # Without the log's settings it is refused, and the options that it names make it go on.
    with pytest.raises(ProjectionMismatch, match="fusion=evidence there, page here") as refused:
        tail(log, targets, Settings(), once=True)
    said = str(refused.value)
    (options,) = re.findall(r"to go on with them give (.*?) instead; to rebuild", said)
    words = shlex.split(options)
    assert set(words[::2]) == {"--set"}
    assert Settings().with_assignments(words[1::2]) == evidence
    append_command(log, command(UseSettings, settings={}))
    assert tail(log, targets, settings_of, once=True).refolds == 1
    assert oid(targets) == table
    rebuild(log, third_database, Settings())
    assert all_rows(targets) == all_rows(third_database)


def test_status_tells_of_a_refold(log: Path, targets: Targets) -> None:
    tail(log, targets, SETTINGS, once=True)
    append_command(log, forget_run("run-b"))
    seen: list[Status] = []

    def look(_done: int, _total: int) -> None:
        if not seen:
            seen.append(projection_status(log, targets, SETTINGS))

    before = projection_status(log, targets, SETTINGS)
    assert [s.condition for s in before.sinks] == ["behind", "behind"]
    assert "1 command came since, the last at offset 120" in str(before.sinks[0].note)
    tail(log, targets, SETTINGS, once=True, on_refold=look)
    (during,) = seen
    assert during.healthy
    assert [s.condition for s in during.sinks] == ["refolding", "refolding"]
    assert during.sinks[0].next_offset == LOG_LENGTH
    assert _sink_line(during.sinks[0]).startswith("refolding, old map at offset 120, 1 behind")
    after = projection_status(log, targets, SETTINGS)
    assert [s.condition for s in after.sinks] == ["idle", "idle"]


@pytest.mark.slow
def test_a_projection_under_other_corrections_is_reported_and_refolded(
    log: Path, one_database: Targets, pg: psycopg.Connection, third_database: Targets
) -> None:
    """Such as one that another version of mapfold has made of the same commands."""
    append_command(log, forget_run("run-b"))
    rebuild(log, one_database, SETTINGS)
    pg.execute("UPDATE mapfold.checkpoint SET fingerprint = repeat('0', 16)")
    status = projection_status(log, one_database, SETTINGS)
    assert {s.condition for s in status.sinks} == {"other"}
    assert "under other corrections" in str(status.sinks[0].note)
    assert "settings" not in str(status.sinks[0].note)
    with pytest.raises(ProjectionMismatch, match="under other corrections"):
        check(log, one_database, SETTINGS)
    assert tail(log, one_database, SETTINGS, once=True).refolds == 1
    assert all_rows(one_database) == fresh_rows(log, third_database)


def test_the_command_line_tells_of_a_refold(
    log: Path, tmp_path: Path, one_database: Targets
) -> None:
    mapfold = Commands.in_folder(tmp_path)

    def told() -> str:
        return mapfold("tail", log, "--once", "--db", one_database.graph_url).err

    assert "120 events written in 1 batch; the databases are at offset 120" in told()
    append_command(log, forget_run("run-b"))
    after = told()
    assert "refolded 1 time because of commands; the databases are at offset 121" in after
    assert "events written" not in after
    assert "0 events written in 0 batches; the databases are at offset 121" in told()
