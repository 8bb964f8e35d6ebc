"""`mapfold ui` on logs that are empty, damaged, of another version, replaced or gone."""

import os
import shutil
from pathlib import Path
from typing import Any

import pytest

from eventsrc.envelope.system_events import COMMAND_KEY
from eventsrc.log import LogReader, LogWriter
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import BY_HAND, KEY, flip
from tests.support.logs import append_raw, walk, write_log
from tests.support.thorough import mostly_slow
from tests.support.ui_page import UiServer, digest, read_arrays, replay, showing, until


def problems(server: UiServer) -> list[str]:
    server.api("digest", at=0)  # after the first fold
    return server.api("log")["problems"]


def test_an_empty_log_that_begins(mapfold: Commands, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with LogWriter(log):
        pass
    with showing(mapfold, log) as server, server.live() as heard:
        (said,) = problems(server)
        assert said.startswith("the log has no events yet")
        header, arrays = read_arrays(server.ask("/api/history").body)
        assert header["through"] == 0
        assert not any(arrays.values())
        assert server.api("digest")["digest"] == digest(mapfold, log)
        write_log(log, walk(3))
        assert until(heard, lambda d: d["through"] == 3)["problems"] == []


def test_a_log_that_has_settings_only(mapfold: Commands, tmp_path: Path) -> None:
    mapfold("import", tmp_path / "log", "-", "--preset", "full", stdin=b"")
    with showing(mapfold, tmp_path / "log") as server:
        (said,) = problems(server)
        assert said.startswith("none of the 1 event is a keyframe, so there is no map; `mapfold r")
        assert "FILE` reads a file" in said


def test_a_log_without_poses(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", [envelope(k, None) for k in range(3)])
    with showing(mapfold, log) as server:
        (said,) = problems(server)
        assert said.startswith("none of the 3 keyframes has a pose")
        header, arrays = read_arrays(server.ask("/api/history").body)
        assert replay(header, arrays, 3).poses == [None] * 3


def test_a_camera_that_nothing_states_is_named(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(5, detections=1))
    by_evidence = ("--set", "fusion=evidence")
    with showing(mapfold, log, *by_evidence) as server:
        assert problems(server) == []  # it does not hide a part of the map
        odd, _ = server.api("overview")["odd"]
        assert odd["says"].startswith("No camera is stated for ")
        assert odd["command"].startswith(f"mapfold edit {log} use-settings --set camera.hfov_deg=")
    with showing(mapfold, log, *by_evidence, "--set", "camera.hfov_deg=69.4") as server:
        (odd,) = server.api("overview")["odd"]
        assert odd["command"] == f"mapfold calibrate {log} --write"


def test_a_damaged_log_is_shown_up_to_the_damage(mapfold: Commands, tmp_path: Path) -> None:
    log = tmp_path / "log"
    documents = [payload(envelope(k, k * 0.4, note="x" * 12_000)) for k in range(300)]
    with LogWriter(log, fsync=BY_HAND) as writer:
        for number, each in enumerate(documents):
            writer.append(KEY, each)
            if number % 100 == 99:
                writer.sync()
    whole = mapfold("state", log, "--at", "100", "--digest").out.strip()
    with LogReader(log) as reader:
        (segment,) = reader.segments
        chunk = reader.open_segment(segment).chunks[1]
    flip(segment.path, chunk.position + chunk.length // 2)
    with showing(mapfold, log) as server:
        (said,) = problems(server)
        assert "offsets 100 to 199 cannot be read" in said
        assert "after 100 events" in said
        told = server.api("log")
        assert told["through"] == 100
        header, arrays = read_arrays(server.ask("/api/history").body)
        assert (header["through"], len(arrays["kf_offset"])) == (100, 100)
        assert server.api("digest")["digest"] == whole
        assert server.api("digest", eps_m=0.2)["at"] == 100
        assert server.api("whatif", set="eps_m=0.2")["events"] == 100
        assert server.api("search", q=":99")["found"]
        assert server.ask("/api/digest", at=101).status == 400


def test_an_event_that_no_fold_takes(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(6))
    append_raw(log, b'{"run_id": 3}')
    write_log(log, walk(6, first=6))
    with showing(mapfold, log) as server:
        (said,) = problems(server)
        assert said.startswith("event at offset 6 cannot be folded")
        assert server.api("log")["through"] == 6
        assert server.api("digest")["digest"] == (
            mapfold("state", log, "--at", "6", "--digest").out.strip()
        )


@pytest.mark.parametrize(
    "command",
    mostly_slow(
        [
            {"kind": "teleport"},
            {"kind": "use-settings", "settings": {"gravity": 9.81}},
            {"kind": "use-settings", "settings": {"eps_m": -1}},
        ]
    ),
)
def test_settings_and_commands_of_another_version(
    mapfold: Commands, tmp_path: Path, command: dict[str, Any]
) -> None:
    log = write_log(tmp_path / "log", walk(6))
    said_by = {"command_id": "c", "issued_by": "a@b", "reason": "x"}
    append_raw(log, payload({**said_by, **command}), key=COMMAND_KEY)
    write_log(log, walk(6, first=6))
    with showing(mapfold, log) as server:
        (said,) = problems(server)
        assert "update mapfold" in said
        assert server.api("log")["through"] == 6
        assert server.ask("/api/history").status == 200


def test_a_log_that_vanishes(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(20))
    with showing(mapfold, log) as server, server.live() as heard:
        before = until(heard, lambda d: d["through"] == 20)
        whole = server.ask("/api/history").body
        shutil.rmtree(log)
        told = until(heard, lambda d: d["problems"])
        assert "is gone" in told["problems"][0]
        assert (told["through"], told["state"]) == (20, before["state"])
        assert server.ask("/api/history").body[-200:] == whole[-200:]
        assert server.api("digest", at=7)["at"] == 7
        got = server.ask("/api/whatif", set="eps_m=1")
        assert got.error[1] == "log"


@pytest.mark.parametrize("events", mostly_slow([3, 20, 40]))
def test_another_log_in_its_place(mapfold: Commands, tmp_path: Path, events: int) -> None:
    log = write_log(tmp_path / "log", walk(20))
    before = digest(mapfold, log)
    with showing(mapfold, log, "--allow-edits") as server, server.live() as heard:
        until(heard, lambda d: d["through"] == 20)
        shutil.rmtree(log)
        write_log(log, walk(events, seed=9, run_id="other"))
        told = until(heard, lambda d: "another log" in " ".join(d["problems"]))
        assert told["through"] == 20
        assert server.api("digest")["digest"] == before
        for got in (
            server.edit("forget-run", "other", reason="x", dry_run=False),
            server.ask("/api/whatif", set="eps_m=1"),
        ):
            assert got.error[1] == "log"
    assert mapfold("edits", log, "--json").json == []


def test_a_log_that_was_put_back_to_an_older_state(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(20))
    older = shutil.copytree(log, tmp_path / "older")
    write_log(log, walk(10, first=20))
    with showing(mapfold, log) as server, server.live() as heard:
        until(heard, lambda d: d["through"] == 30)
        shutil.rmtree(log)
        older.rename(log)
        told = until(heard, lambda d: d["problems"])
        assert "has 20 events now, fewer than the 30" in " ".join(told["problems"])
        assert server.api("digest")["at"] == 30


def test_a_log_that_is_truncated(mapfold: Commands, tmp_path: Path) -> None:
    log = write_log(tmp_path / "log", walk(20))
    (segment,) = log.glob("*.mcap*")
    with showing(mapfold, log) as server, server.live() as heard:
        until(heard, lambda d: d["through"] == 20)
        os.truncate(segment, segment.stat().st_size // 2)
        told = until(heard, lambda d: d["problems"])
        assert "the index at its end cannot be read" in told["problems"][0]
        assert server.api("digest")["at"] == 20


def test_no_log_is_an_error_of_the_command(mapfold: Commands, tmp_path: Path) -> None:
    assert "no log at" in mapfold("ui", tmp_path / "none", code=2).err
    (tmp_path / "file").write_text("x")
    assert "is a file" in mapfold("ui", tmp_path / "file", code=2).err
    log = write_log(tmp_path / "log", walk(2))
    assert "eps_m" in mapfold("ui", log, "--set", "eps_m=x", code=2).err
    assert "--port" in mapfold("ui", log, "--host", "192.0.2.7", code=1).err
