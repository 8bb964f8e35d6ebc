"""From a merge that was wrong to two places in the graph, and back, with the commands as typed."""

import json
import shutil
from pathlib import Path

import psycopg
import pytest

from eventsrc.log import NEVER, LogWriter
from eventsrc.record.append import append_payload
from tests.support.commands import Commands
from tests.support.logs import sample_drive
from tests.support.servers import furnish
from tests.support.shared_data import shared_run

SAMPLE = sample_drive()
FINE = {"eps_m": 0.75, "min_samples": 8}


def copied_log(name: str, folder: Path) -> Path:
    log = folder / "log"
    if name == "sample":
        shutil.copytree(SAMPLE, log)
        return log
    with LogWriter(log, fsync=NEVER) as writer:
        for number, payload in enumerate(shared_run(name), 1):
            append_payload(writer, "tb/detections", payload, logged_ns=number * 1_000_000_000)
    return log


def places_in_age(mapfold: Commands) -> set[str]:
    mapfold("db", "start")
    url = mapfold("db", "url", "--json").json["url"]
    with psycopg.connect(url) as connection:
        rows = connection.execute('SELECT properties::text FROM semantic_map."Place"').fetchall()
    mapfold("db", "stop")
    return {json.loads(properties)["place_id"] for (properties,) in rows}


@pytest.mark.parametrize("name", ["sample", pytest.param("house-a", marks=pytest.mark.slow)])
@pytest.mark.slow
def test_an_undone_merge_is_two_places_after_every_rebuild_and_one_again_after_undo(
    tmp_path: Path, name: str
) -> None:
    log, mapfold = copied_log(name, tmp_path), Commands.in_folder(tmp_path)
    furnish(mapfold.home)
    (tmp_path / "fine.json").write_text(json.dumps(FINE))
    mapfold("edit", log, "use-settings", "fine.json", "--reason", "the rooms are small")
    digest = mapfold("replay", log, "--json").json["digest"]
    before = places_in_age(mapfold)
    merge = mapfold("merges", log, "--json").json[-1]  # nothing merged after it
    survivor, (absorbed,) = merge["survivor"], merge["absorbed"]
    assert len({survivor, absorbed} & before) < 2

    edited = mapfold(
        "edit", log, "undo-merge", str(merge["offset"]), "--reason", "a door between", "--json"
    ).json
    mapfold("tail", log, "--once")
    two = places_in_age(mapfold)
    assert {survivor, absorbed} <= two
    assert mapfold("status", log).code == 0
    mapfold("db", "check", log)

    shutil.rmtree(mapfold.home)
    furnish(mapfold.home)
    shutil.rmtree(tmp_path / "log.history", ignore_errors=True)
    other = mapfold("replay", log, "--json").json["digest"]
    assert other != digest
    assert places_in_age(mapfold) == two

    command_id = edited["command"]["command_id"] if "command" in edited else edited["command_id"]
    mapfold("edit", log, "undo", command_id, "--reason", "no door after all")
    mapfold("tail", log, "--once")
    assert places_in_age(mapfold) == before
    status = mapfold("status", log, "--json").json
    assert {sink["condition"] for sink in status["sinks"].values()} == {"idle"}
    assert status["sinks"]["graph"]["digest"] == digest
    assert mapfold("state", log, "--digest").out.strip() == digest
