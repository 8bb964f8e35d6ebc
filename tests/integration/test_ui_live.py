"""`mapfold ui` on a log that grows, under its own settings and others."""

import shlex
import shutil
import time
from pathlib import Path

import pytest

from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY, RejectedPayload
from tests.support.commands import Commands
from tests.support.envelopes import payload
from tests.support.http_attacks import connect, request
from tests.support.logs import append_raw, bridge, walk, write_log
from tests.support.shared_data import ROOT
from tests.support.thorough import rounds
from tests.support.ui_page import UiServer, digest, read_arrays, replay, showing, until


class TestGrowing:
    def test_a_page_follows(self, mapfold: Commands, tmp_path: Path) -> None:
        documents = [*walk(30, seed=2), *bridge()]
        log = write_log(tmp_path / "log", documents[:10])
        with showing(mapfold, log) as server, server.live() as heard:
            first = until(heard, lambda d: d["through"] == 10)
            header, arrays = read_arrays(server.ask("/api/history").body)
            for end in (11, 30, 50):
                write_log(log, documents[header["through"] : end])
                told = until(heard, lambda d, end=end: d["through"] == end)
                assert told["state"] == first["state"] == header["state"]
                assert told["lag"] == 0
                more, new = read_arrays(
                    server.ask("/api/history", **{"from": header["through"]}).body
                )
                assert more["from"] == header["through"]
                for name, values in new.items():
                    arrays[name] += values
                for kind in ("place_id", "object_id"):
                    assert more["first"][kind] == len(header["strings"][kind])
                    header["strings"][kind] += more["strings"][kind]
                header["strings"] |= {k: more["strings"][k] for k in ("class", "run_id")}
                header["names"] += more["names"]
                header["through"] = more["through"]
                assert server.api("digest")["digest"] == digest(mapfold, log)
            whole = read_arrays(server.ask("/api/history").body)
            for at in (9, 10, 11, 29, 45, 50):
                assert repr(replay(header, arrays, at)) == repr(replay(*whole, at))  # NaN too

    def test_losses_and_rejected_payloads_are_told(self, mapfold: Commands, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", walk(5))
        with showing(mapfold, log) as server, server.live() as heard:
            assert until(heard, lambda d: d["through"] == 5)["losses"] == 0
            loss = {"publisher": "run-a", "first": 7, "last": 9, "count": 3, "cause": "queue_full"}
            append_raw(log, payload(loss), key=LOSS_KEY)
            append_raw(log, RejectedPayload.encode("k", "no JSON", b"?"), key=REJECTED_KEY)
            append_raw(log, b"not even JSON", key=LOSS_KEY)
            told = until(heard, lambda d: d["through"] == 8)
            assert (told["losses"], told["rejected"]) == (3, 1)
            header, arrays = read_arrays(server.ask("/api/history").body)
            kinds = [header["kinds"][kind] for kind in arrays["ev_kind"]]
            assert kinds[-3:] == ["loss", "rejected", "loss"]
            own = [header["system"][ref]["text"] for ref in arrays["ev_ref"][-3:]]
            assert own[0] == "3 lost of run-a, 7 to 9 (queue_full)"
            assert own[1] == "k: no JSON"

    def test_a_command_of_another_program_changes_the_state(
        self, mapfold: Commands, tmp_path: Path
    ) -> None:
        log = write_log(tmp_path / "log", [*walk(30, seed=2), *bridge()])
        with showing(mapfold, log) as server, server.live() as heard:
            before = until(heard, lambda d: d["through"] == 50)
            merge = server.api("merges")["merges"][0]
            mapfold("edit", log, "undo-merge", str(merge["offset"]), "--reason", "two rooms")
            after = until(heard, lambda d: d["through"] == 51)
            assert after["state"] != before["state"]
            assert server.api("digest")["digest"] == digest(mapfold, log)
            assert server.api("digest", at=50)["digest"] == (
                mapfold("state", log, "--at", "50", "--digest").out.strip()
            )
            hindsight = server.api("digest", at=50, known_at=51)
            words = ("--at", "50", "--known-at", "51", "--digest")
            assert hindsight["digest"] == mapfold("state", log, *words).out.strip()
            assert "--known-at 51" in hindsight["command"]

    def test_the_end_of_the_server_ends_the_stream(self, mapfold: Commands, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", walk(5))
        server = UiServer(mapfold, log)
        with server.live() as heard:
            until(heard, lambda d: d["through"] == 5)
            assert server.end() == 0
            assert list(heard) == []


def test_pages_that_leave_do_not_delay_others(mapfold: Commands, tmp_path: Path) -> None:
    """Hundreds of folds are asked for and abandoned; the next answer comes soon."""
    log = write_log(tmp_path / "log", walk(rounds(1300, 600), seed=5, detections=1))
    with showing(mapfold, log) as server:
        one = server.api("digest", eps_m=2.0)["refold_ms"] / 1e3
        for number in range(60):
            path = f"/api/history?eps_m={1 + number / 100}"
            with connect(server.port) as connection:
                connection.sendall(request("GET", path))
        started = time.monotonic()
        assert server.api("digest", eps_m=2.5)["at"] == rounds(1300, 600)
        assert time.monotonic() - started < max(15 * one, 5.0)  # not 60 folds


def test_settings_of_the_command_line(mapfold: Commands, tmp_path: Path) -> None:
    log = shutil.copytree(ROOT / "logs" / "sample", tmp_path / "log")
    (tmp_path / "wide.json").write_text('{"eps_m": 1.0, "min_samples": 8}')
    with showing(mapfold, log, "--settings", "wide.json", "--set", "eps_m=0.9") as server:
        answer = server.api("digest")
        told = server.api("log")
        assert told["changed_settings"] == {"eps_m": 0.9, "min_samples": 8}
        state = ("state", log, "--settings", "wide.json", "--set", "eps_m=0.9", "--digest")
        assert answer["digest"] == mapfold(*state).out.strip()
        assert "--settings wide.json --set eps_m=0.9" in answer["command"]
        whatif = server.api("whatif", set="min_samples=3")
        assert whatif["base"]["digest"] == answer["digest"]
        assert "--base eps_m=0.9" in whatif["command"]


@pytest.mark.slow
def test_truth_scores_other_settings(mapfold: Commands, tmp_path: Path) -> None:
    log, run = tmp_path / "log", tmp_path / "run.jsonl"
    mapfold("simulate", "--out", run)
    mapfold("import", log, run)
    with showing(mapfold, log, "--truth", tmp_path / "run.truth.jsonl") as server:
        answer = server.api("whatif", set=["eps_m=0.6", "min_samples=8"])
        (alternative,) = answer["alternatives"]
        assert 0.8 < alternative["truth"]["places"]["v_measure"] < 0.9
        words = shlex.split(answer["command"])[1:]
        assert mapfold(*words, "--all").out.splitlines() == answer["lines"]


def test_a_correction_of_the_log_is_marked(mapfold: Commands, tmp_path: Path) -> None:
    """A command in the log is in force from the start of the page, and marked."""
    log = write_log(tmp_path / "log", [*walk(30, seed=2), *bridge()])
    offset = mapfold("merges", log, "--json").json[0]["offset"]
    mapfold("edit", log, "undo-merge", str(offset), "--reason", "apart")
    with showing(mapfold, log) as server:
        header, arrays = read_arrays(server.ask("/api/history").body)
        assert header["known_at"] == 51
        marks = [header["kinds"][kind] for kind in arrays["ev_kind"]]
        assert "correction" in marks
        assert "merge_refused" in marks
        assert header["refusals"]
        earlier, _ = read_arrays(server.ask("/api/history", known_at=50).body)
        assert earlier["refusals"] == []
