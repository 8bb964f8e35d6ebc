"""`mapfold ui` on a log that grows, is corrected, is damaged or vanishes."""

import json
import shlex
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from eventsrc.log import LogReader, LogWriter
from eventsrc.system_events import COMMAND_KEY, LOSS_KEY, REJECTED_KEY, RejectedPayload
from tests.commands import Commands
from tests.envelopes import envelope, payload
from tests.fixtures_log import BY_HAND, KEY, flip
from tests.http_attacks import connect, request
from tests.logs import append_raw, bridge, walk, write_log
from tests.shared_data import ROOT
from tests.thorough import every_other, mostly_slow, rounds
from tests.ui_client import read_arrays, replay
from tests.ui_server import UiServer, showing


@pytest.fixture
def mapfold(tmp_path: Path) -> Commands:
    return Commands.in_folder(tmp_path)


def until(heard: Iterator[dict[str, Any]], holds: Callable[[dict[str, Any]], bool]) -> Any:
    """The first document for which it holds; the stream's own timeout is the deadline."""
    return next(each for each in heard if holds(each))


def digest(mapfold: Commands, log: Path) -> str:
    return mapfold("state", log, "--digest").out.strip()


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


class TestEdits:
    @pytest.fixture
    def log(self, tmp_path: Path) -> Path:
        return write_log(tmp_path / "log", [*walk(30, seed=2), *bridge()])

    @pytest.fixture
    def server(self, mapfold: Commands, log: Path) -> Iterator[UiServer]:
        with showing(mapfold, log, "--allow-edits") as started:
            yield started

    def test_a_dry_run_a_command_and_its_undo(
        self, mapfold: Commands, log: Path, server: UiServer
    ) -> None:
        offset = str(server.api("merges")["merges"][0]["offset"])
        before = server.api("digest")["digest"]
        preview = server.edit("undo-merge", offset).json
        assert preview["recorded"] is False
        assert preview["through"] == server.api("log")["through"] == 50
        assert preview["effect"]["places"] > 0
        got = server.edit("undo-merge", offset, dry_run=False)
        assert got.error == (
            400, "bad_question",
            "the reason is missing: say why, for later readers of the log",
        )  # fmt: skip
        done = server.edit("undo-merge", offset, dry_run=False, reason="two rooms").json
        assert (done["recorded"], done["offset"], done["through"]) == (True, 50, 51)
        assert done["effect"] == preview["effect"]
        after = server.api("digest")["digest"]
        assert after == preview["difference"]["digests"][1] == digest(mapfold, log)
        listed = mapfold("edits", log, "--json").json
        assert listed[0]["reason"] == "two rooms"
        again = {"reason": "two rooms", "dry_run": False, "command_id": done["command_id"]}
        assert server.edit("undo-merge", offset, **again).json["repeated"] is True
        undone = server.edit("undo", done["command_id"], dry_run=False, reason="no").json
        assert undone["through"] == 52
        assert server.api("digest")["digest"] == digest(mapfold, log)
        answer = server.api("corrections")
        assert answer["corrections"][0]["undone_by"] == undone["command_id"]
        told = [{k: v for k, v in c.items() if k != "text"} for c in answer["corrections"]]
        assert told == mapfold("edits", log, "--json").json
        known = server.api("digest", at=50, known_at=50)["digest"]
        assert known == before

    def test_every_kind_says_what_the_command_says(
        self, mapfold: Commands, log: Path, server: UiServer
    ) -> None:
        """The same change, or the same sentence."""
        state = mapfold("state", log, "--json").json
        place, objects = state["places"][0]["place_id"], state["objects"]
        det_id = objects[0]["det_ids"][0]
        edits = [
            ("name-place", place, "kitchen"),
            ("keep-apart", "run-a:1", "run-b:3"),
            ("join", place, "run-b:3"),
            ("same-object", objects[0]["object_id"], objects[1]["object_id"]),
            ("different-objects", *objects[0]["det_ids"][:2]),
            ("drop-object", objects[0]["object_id"]),
            ("drop-detection", det_id, objects[1]["det_ids"][0]),
            ("forget-run", "run-b"),
            ("forget-keyframes", "run-a", "3..9"),
            ("undo", "nothing"),
            ("undo-merge", "9999"),
        ]
        for kind, *arguments in every_other(edits):
            got = server.edit(kind, *arguments)
            words = ("edit", log, kind, "--dry-run", "--json", "--", *arguments)
            said = mapfold(*words, code=None)
            if said.code == 0:
                assert got.status == 200, got.body
                assert got.json["effect"] == said.json["effect"], kind
                assert got.json["difference"] == said.json["difference"], kind
            else:
                assert got.status in (400, 404), kind
                assert said.err == f"mapfold: {got.error[2]}\n"
        got = server.edit("correct-poses", "run-a", "1.5", "0", "0").json
        words = ("correct-poses", "run-a", "--dx", "1.5", "--dy", "0", "--dyaw", "0")
        said = mapfold("edit", log, *words, "--dry-run", "--json").json
        assert got["difference"] == said["difference"]
        got = server.edit("use-settings", "eps_m=0.5").json
        words = ("use-settings", "--set", "eps_m=0.5")
        said = mapfold("edit", log, *words, "--dry-run", "--json").json
        assert got["difference"] == said["difference"]
        assert server.api("log")["through"] == 50

    def test_nonsense(self, server: UiServer) -> None:
        bearer = {"Authorization": f"Bearer {server.token}"}
        far = {"kind": "correct-poses", "arguments": ["run-a", "x", "0", "0"]}
        for document, said in (
            ([], "the edit"),
            ({}, "kind"),
            ({"kind": "nothing"}, "no edit 'nothing'"),
            ({"kind": "undo"}, "undo has 0 arguments; give COMMAND_ID"),
            ({"kind": "undo", "arguments": ["a", "b"]}, "undo has 2 arguments"),
            ({"kind": "undo", "arguments": [1]}, "arguments.0"),
            ({"kind": "undo", "arguments": "a"}, "arguments"),
            ({"kind": "undo-merge", "arguments": ["x"]}, "undo-merge is of offset 'x'"),
            (far, "'x' is no number"),
            ({"kind": "undo", "more": 1}, "more"),
        ):
            body = json.dumps(document).encode()
            got = server.ask("/api/edit", method="POST", body=body, headers=bearer)
            assert got.error[:2] == (400, "bad_question")
            assert said in got.error[2]

    def test_a_log_that_another_writer_holds(self, log: Path, server: UiServer) -> None:
        with LogWriter(log):
            assert server.edit("forget-run", "run-b").json["recorded"] is False
            got = server.edit("forget-run", "run-b", dry_run=False, reason="x")
            assert got.status == 500
            assert "a recorder" in got.error[2] or "no recorder" in got.error[2]
        assert server.edit("forget-run", "run-b", dry_run=False, reason="x").json["recorded"]


class TestProblems:
    """A sentence on the page, and what can be read."""

    def problems(self, server: UiServer) -> list[str]:
        server.api("digest", at=0)  # after the first fold
        return server.api("log")["problems"]

    def test_an_empty_log_that_begins(self, mapfold: Commands, tmp_path: Path) -> None:
        log = tmp_path / "log"
        with LogWriter(log):
            pass
        with showing(mapfold, log) as server, server.live() as heard:
            (said,) = self.problems(server)
            assert said.startswith("the log has no events yet")
            header, arrays = read_arrays(server.ask("/api/history").body)
            assert header["through"] == 0
            assert not any(arrays.values())
            assert server.api("digest")["digest"] == digest(mapfold, log)
            write_log(log, walk(3))
            assert until(heard, lambda d: d["through"] == 3)["problems"] == []

    def test_a_log_without_poses(self, mapfold: Commands, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", [envelope(k, None) for k in range(3)])
        with showing(mapfold, log) as server:
            (said,) = self.problems(server)
            assert said.startswith("none of the 3 keyframes has a pose")
            header, arrays = read_arrays(server.ask("/api/history").body)
            assert replay(header, arrays, 3).poses == [None] * 3

    def test_a_damaged_log_is_shown_up_to_the_damage(
        self, mapfold: Commands, tmp_path: Path
    ) -> None:
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
            (said,) = self.problems(server)
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

    def test_an_event_that_no_fold_takes(self, mapfold: Commands, tmp_path: Path) -> None:
        log = write_log(tmp_path / "log", walk(6))
        append_raw(log, b'{"run_id": 3}')
        write_log(log, walk(6, first=6))
        with showing(mapfold, log) as server:
            (said,) = self.problems(server)
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
        self, mapfold: Commands, tmp_path: Path, command: dict[str, Any]
    ) -> None:
        log = write_log(tmp_path / "log", walk(6))
        said_by = {"command_id": "c", "issued_by": "a@b", "reason": "x"}
        append_raw(log, payload({**said_by, **command}), key=COMMAND_KEY)
        write_log(log, walk(6, first=6))
        with showing(mapfold, log) as server:
            (said,) = self.problems(server)
            assert "update mapfold" in said
            assert server.api("log")["through"] == 6
            assert server.ask("/api/history").status == 200

    def test_a_log_that_vanishes(self, mapfold: Commands, tmp_path: Path) -> None:
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
    def test_another_log_in_its_place(self, mapfold: Commands, tmp_path: Path, events: int) -> None:
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

    def test_a_log_that_was_put_back_to_an_older_state(
        self, mapfold: Commands, tmp_path: Path
    ) -> None:
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

    def test_no_log_is_an_error_of_the_command(self, mapfold: Commands, tmp_path: Path) -> None:
        assert "no log at" in mapfold("ui", tmp_path / "none", code=2).err
        (tmp_path / "file").write_text("x")
        assert "is a file" in mapfold("ui", tmp_path / "file", code=2).err
        log = write_log(tmp_path / "log", walk(2))
        assert "eps_m" in mapfold("ui", log, "--set", "eps_m=x", code=2).err
        assert "--port" in mapfold("ui", log, "--host", "192.0.2.7", code=1).err


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
