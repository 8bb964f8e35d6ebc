"""`mapfold log redact`: what is erased is nowhere, all else is as it was, and the log proves it."""

import base64
import hashlib
import json
import os
import random
import shutil
import signal
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from eventsrc.base.errors import LogBusy, LogDamaged
from eventsrc.envelope.commands import Reembed, encode_command
from eventsrc.envelope.crops import CROPS_TOPIC, Crop, decode_crop, encode_crop
from eventsrc.envelope.model import DetId, KeyframeId, RunId, default_det_id
from eventsrc.envelope.system_events import (
    COMMAND_KEY,
    EMBEDDINGS_KEY,
    REDACTED_KEY,
    REDACTION_KEY,
    REJECTED_KEY,
    ROS_KEY,
    NewVectors,
    RejectedPayload,
)
from eventsrc.log import Event, LogReader, LogWriter, NewEvent, cache_folder, verify_log
from eventsrc.log.redact import Pending, Redactor, staging_folder
from eventsrc.record.append import CROP_FORMAT
from eventsrc.ros.derivation import RosRecording
from eventsrc.ros.stream import Stream
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.fold import fold_log
from projections.map.parsing import read_corrections
from projections.postgres import rebuild
from projections.postgres.connection import Targets, connect
from projections.surfaces.cli.redact_command import redact
from tests.support.byte_search import holds
from tests.support.commands import Commands
from tests.support.dying import die_at
from tests.support.envelopes import detection, embedding, envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.thorough import rounds

EVENTS = 40
WHO = ("--reason", "a request", "--issued-by", "me@here")


def secret(number: int) -> list[float]:
    """The vector of a person, of its own in every keyframe."""
    return [float(0.001 * number + 0.1), 0.25, 7.125, float(number)]


def seen(number: int, run: str = "home") -> dict[str, Any]:
    """A keyframe with a cup, and in every third a person between two things."""
    things = [detection("cup", [1.0, 0.0, 0.0, 0.1 * (number % 3)])]
    if number % 3 == 0:
        things += [detection("person", secret(number), note=f"face-{number}-")]
        things += [detection("chair", [0.0, 1.0, 0.0, 0.0])]
    return envelope(number, 0.4 * number, 0.0, run_id=run, detections=things)


def person(number: int) -> DetId:
    return default_det_id(seen(number)["run_id"], seen(number)["keyframe_id"], 1)


def jpeg(number: int) -> bytes:
    return b"\xff\xd8\xff" + f"jpeg-of-{number}-".encode() + b"\xff\xd9"


def traces(number: int) -> list[bytes]:
    """The bytes that show the person of a keyframe."""
    vector = str(embedding(secret(number))["embedding"]).encode()
    return [vector, base64.b64decode(vector), f"face-{number}-".encode(), jpeg(number)[3:-2]]


PEOPLE = [number for number in range(EVENTS) if number % 3 == 0]


def write(path: Path, events: int = EVENTS, rotate: int = 25) -> None:
    """A log of some segments with crops, and refused payloads."""
    with LogWriter(path, rotate_events=rotate) as writer:
        for number in range(events):
            made = [NewEvent(KEY, payload(seen(number)), 10**9 * number, 10**9 * number)]
            if number % 3 == 0:
                kept = encode_crop(Crop(person(number), jpeg(number)), 10**9 * number)
                made += [NewEvent(CROPS_TOPIC, kept, 10**9 * number, 1, format=CROP_FORMAT)]
            if number % 9 == 0:
                broken = payload({**seen(number), "timestamp": "late"})
                refused = RejectedPayload.encode(KEY, "wrong", broken)
                made += [NewEvent(REJECTED_KEY, refused, 10**9 * number, 10**9 * number)]
            writer.append_all(made)
            writer.sync()


def digest(log: Path) -> str:
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        return map_digest(fold_log(reader, Settings(), corrections=corrections)[1])


def redactions(log: Path) -> list[dict[str, Any]]:
    return [json.loads(e.payload) for e in read_log(log) if e.key == REDACTION_KEY]


def unchanged(before: list[Event], after: list[Event]) -> None:
    """Everything but what is listed is as it was; offsets, times and number too."""
    listed = {o for e in after if e.key == REDACTION_KEY for o in json.loads(e.payload)["offsets"]}
    assert len(after) >= len(before)
    for was, now in zip(before, after, strict=False):
        times = was.offset, was.logged_ns, was.stamp_ns
        assert times == (now.offset, now.logged_ns, now.stamp_ns)
        assert was == now or was.offset in listed
        if was.offset in listed:
            assert was.payload != now.payload


@pytest.fixture
def run(tmp_path: Path) -> Commands:
    write(tmp_path / "log")
    return Commands.in_folder(tmp_path)


def test_a_class_is_erased_and_the_log_proves_it(run: Commands, tmp_path: Path) -> None:
    log = tmp_path / "log"
    before = read_log(log)
    assert holds(log, traces(3))
    run("state", "log")  # a history, if the log is long enough for one
    plan = run("log", "redact", "log", "--class", "person", "--dry-run", "--json")
    assert plan.json["detections"] == plan.json["crops"] == len(PEOPLE)
    assert plan.json["keyframes_in_part"] == len(PEOPLE)
    assert plan.json["segments"] == 3
    assert "events in 3 segments would change: 14 detections" in plan.err
    assert read_log(log) == before
    people = [person(number) for number in PEOPLE]
    run("edit", "log", "drop-detection", *people, "--reason", "forgotten first")
    forgotten = digest(log)
    said = run("log", "redact", "log", "--class", "person", *WHO, "--json")
    assert said.json["detections"] == len(PEOPLE)
    assert "not reached: exports" in said.err
    for number in PEOPLE:
        assert holds(tmp_path, traces(number)) == []
    after = read_log(log)
    unchanged(before, after)
    assert digest(log) == forgotten
    for each in redactions(log):
        assert each["digest_before"] == each["digest_after"] == forgotten
        assert (each["issued_by"], each["reason"]) == ("me@here", "a request")
    found = verify_log(log)
    assert found.findings == ()
    (proved,) = found.redactions
    changed = sum(len(each["offsets"]) for each in redactions(log))
    assert (proved.issued_by, proved.payloads) == ("me@here", changed)
    told = run("log", "verify", "log").err
    assert f"{changed} payloads redacted by me@here (class person): a request" in told
    one = next(e for e in after if e.is_envelope and json.loads(e.payload).get("redaction"))
    kept = json.loads(one.payload)
    assert [each["class"] for each in kept["detections"]] == ["cup", "chair"]
    assert kept["detections"][1]["det_id"].endswith("_d2")
    assert kept["redacted_detections"] == 1
    assert (
        "nothing of that is in the log"
        in run("log", "redact", "log", "--class", "person", *WHO).err
    )


def test_without_forgetting_first_the_digest_is_that_of_the_log_without_them(
    run: Commands, tmp_path: Path
) -> None:
    run("log", "redact", "log", "--class", "person", *WHO)
    with LogWriter(tmp_path / "other") as writer:
        for number in range(EVENTS):
            document = seen(number)
            of = document["run_id"], document["keyframe_id"]
            document["detections"] = [
                {**each, "det_id": default_det_id(*of, i)}
                for i, each in enumerate(document["detections"])
                if each["class"] != "person"
            ]
            writer.append(KEY, payload(document))
    one, other = digest(tmp_path / "log"), digest(tmp_path / "other")
    with LogReader(tmp_path / "log") as reader, LogReader(tmp_path / "other") as second:
        views = [fold_log(each, Settings())[1] for each in (reader, second)]
    assert len(views[0].observations) == len(views[1].observations)
    assert [o.det_id for o in views[0].observations] == [o.det_id for o in views[1].observations]
    assert redactions(tmp_path / "log")[0]["digest_after"] == one
    assert one == other  # though their offsets differ


def test_one_detection_and_crops_only(run: Commands, tmp_path: Path) -> None:
    log = tmp_path / "log"
    run("log", "redact", "log", "--det", person(9), "--crops-only", *WHO)
    assert [decode_crop(e.payload).det_id for e in read_log(log) if e.key == CROPS_TOPIC] == [
        person(number) for number in PEOPLE if number != 9
    ]
    assert holds(tmp_path, [jpeg(9)[3:-2]]) == []
    assert holds(log, traces(9)[:1])
    run("log", "redact", "log", "--det", person(9), *WHO)
    for number in PEOPLE:
        assert (holds(tmp_path, traces(number)) == []) is (number == 9), number
    found = verify_log(log)
    assert found.findings == ()
    assert len(found.redactions) == 2


def test_a_run_and_a_time_go_whole(tmp_path: Path) -> None:
    run, log = Commands.in_folder(tmp_path), tmp_path / "log"
    with LogWriter(log, rotate_events=7) as writer:
        for number in range(20):
            document = seen(number, run="guest" if number % 2 else "home")
            writer.append(KEY, payload(document), stamp_ns=10**9 * number, logged_ns=10**9 * number)
    before = read_log(log)
    run("edit", "log", "forget-run", "guest", "--reason", "forgotten first")
    forgotten = digest(log)
    run("log", "redact", "log", "--run", "guest", *WHO)
    assert digest(log) == forgotten
    after = read_log(log)
    unchanged(before, after)
    assert [e.offset for e in after if e.key == REDACTED_KEY] == list(range(1, 20, 2))
    run("log", "redact", "log", "--before", "1970-01-01T00:00:10", *WHO)
    gone = {e.offset for e in read_log(log) if e.key == REDACTED_KEY}
    assert gone == {n for n in range(20) if n % 2 or n < 10}
    assert verify_log(log).findings == ()
    state = run("state", "log", "--at", "15", "--json").json
    assert [k["keyframe_id"] for k in state["keyframes"]] == [10, 12, 14]
    run("import", "copy", "log", code=3)  # tombstones and redactions are of their own log
    assert not {REDACTED_KEY, REDACTION_KEY} & {e.key for e in read_log(tmp_path / "copy")}


def test_changes_after_a_redaction_are_found(run: Commands, tmp_path: Path) -> None:
    """Of a tombstone, of what was kept, and a tombstone that nothing lists."""
    log = tmp_path / "log"
    run("log", "redact", "log", "--class", "person", *WHO)
    for wanted, text in (
        (lambda e: b"redaction" in e.payload and e.is_envelope, "is not the one that the"),
        (lambda e: b"redaction" not in e.payload and e.is_envelope, "have changed since"),
    ):
        forged = tmp_path / "forged"
        shutil.copytree(log, forged)
        at = next(e.offset for e in read_log(forged) if wanted(e))

        def decide(event: Event, at: int = at) -> Any:
            from eventsrc.log.redact import Rewritten

            return Rewritten(event.payload + b" ") if event.offset == at else None

        with Redactor(forged) as redactor:
            redactor.stage(decide, b"")
            redactor.commit([], 0)
        with LogWriter(forged):
            pass
        pending = Pending.of(forged)
        assert pending is not None
        pending.finish()
        found = [each.message for each in verify_log(forged).findings if each.kind == "redaction"]
        assert any(text in each for each in found), found
        shutil.rmtree(forged)


def test_a_recorder_holds_the_log(run: Commands, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log"):
        assert (
            "is being written by"
            in run("log", "redact", "log", "--class", "person", *WHO, code=1).err
        )
        with pytest.raises(LogBusy):
            Redactor(tmp_path / "log")
    assert holds(tmp_path, traces(3))


def test_misuse_is_one_line(run: Commands) -> None:
    for words, text in (
        ((), "nothing is selected"),
        (("--class", "person"), "--reason TEXT is missing"),
        (("--before", "yesterday", *WHO), "--before yesterday: give an ISO time"),
        (("--resume", "--run", "a"), "give it alone"),
    ):
        assert text in run("log", "redact", "log", *words, code=2).err
    assert "no redaction was begun" in run("log", "redact", "log", "--resume").err
    run("log", "redact", "none", "--run", "a", *WHO, code=2)
    assert not (run.folder / "none").exists()


def test_a_forged_journal_moves_no_other_file(tmp_path: Path) -> None:
    log = tmp_path / "log"
    write(log, events=1)
    staging_folder(log).mkdir()
    (staging_folder(log) / "theirs").write_bytes(b"?")
    document = {"segments": ["../.redaction/theirs"], "first": 0, "payloads": [], "recorded": 0}
    (staging_folder(log) / "journal.json").write_text(json.dumps(document))
    with pytest.raises(LogDamaged, match="names what is no segment"):
        LogWriter(log)


@pytest.mark.seconds
@pytest.mark.slow
def test_killed_at_random_moments_it_goes_on_or_was_never_begun(quick_path: Path) -> None:
    """By --resume, by the next recorder, or by the next redaction."""
    chance, events = random.Random(7), 24
    write(quick_path / "whole", events=events, rotate=8)
    before = read_log(quick_path / "whole")
    people = [number for number in range(events) if number % 3 == 0]
    outcomes = set()
    for number in range(rounds(10, 50)):
        log = quick_path / f"log{number}"
        shutil.copytree(quick_path / "whole", log)
        killed = _redact_killed(log, calls=chance.randrange(CALLS))
        begun = Pending.of(log) is not None or bool(redactions(log))
        outcomes.add((killed, begun))
        if number % 3 == 0:
            with LogWriter(log):  # a recorder goes on with it
                pass
        redact(log, resume=True)
        if not begun:
            assert read_log(log) == before
            redact(log, class_=["person"], reason="x")
        unchanged(before, read_log(log))
        assert verify_log(log).findings == ()
        assert not staging_folder(log).exists()
        assert not cache_folder(log).exists()
        assert holds(log, [trace for each in people for trace in traces(each)]) == []
        shutil.rmtree(log)
    assert {(True, False), (True, True)} <= outcomes


CALLS = 40
"""How many calls of a redaction change files, about; it is killed at one of them."""


def _redact_killed(log: Path, calls: int) -> bool:
    """Redact in a process of its own, which is killed at its call of this number that changes
    files; whether it was."""
    pid = os.fork()
    if pid == 0:
        try:
            die_at(calls)
            redact(log, class_=["person"], reason="x")
        finally:
            os._exit(0)
    _, status = os.waitpid(pid, 0)
    return os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL


def test_databases_give_the_bytes_up(run: Commands, tmp_path: Path, one_database: Targets) -> None:
    """Rows are made again of the log as it is, and of the old ones nothing is in the files of the
    tables; the server's log of changes (pg_wal) is not reached."""
    rebuild(tmp_path / "log", one_database, Settings())
    urls = ("--db", one_database.graph_url, "--vector-db", one_database.vector_url)
    killed = patch(
        "projections.surfaces.cli.redact_command._rebuild", side_effect=KeyboardInterrupt
    )
    with killed, pytest.raises(KeyboardInterrupt):
        redact(tmp_path / "log", class_=["person"], reason="x", db=urls[1], vector_db=urls[3])
    assert "rows of what it erased" in run("log", "redact", "log", "--resume", code=1).err
    said = run("log", "redact", "log", "--resume", *urls)
    assert "pg_wal" in said.err
    with connect(one_database.vector_url, autocommit=True) as connection:
        rows = connection.execute("SELECT class_name FROM detection_embeddings").fetchall()
        folder = connection.execute("SHOW data_directory").fetchone()
        base = connection.execute(
            "SELECT oid::text FROM pg_database WHERE datname = current_database()"
        ).fetchone()
    assert {name for (name,) in rows} == {"cup", "chair"}
    assert folder is not None
    assert base is not None
    files = Path(folder[0]) / "base" / base[0]
    assert holds(files, [traces(number)[1] for number in PEOPLE]) == []


def test_vectors_of_another_space_go_and_the_map_in_it_stays(tmp_path: Path) -> None:
    """Their command's sum is corrected, so that the map in that space can be made."""
    import numpy as np  # every worker imports every test module

    run, log = Commands.in_folder(tmp_path), tmp_path / "log"
    write(log, events=7)
    people = [person(number) for number in (0, 3, 6)]
    cups = [default_det_id(RunId("home"), KeyframeId(number), 0) for number in range(7)]
    vectors = {name: [1.0, 2.0, 40.0 + i] for i, name in enumerate([*cups, *people])}
    made = [NewVectors("B", "0" * 64, tuple(some), _rows(vectors, some)) for some in (cups, people)]
    made.append(NewVectors("B", "0" * 64, (person(0),), np.array([[9.0, 8.0, 7.0]], np.float32)))
    with LogWriter(log) as writer:
        first = writer.next_offset
        for each in made:
            writer.append(EMBEDDINGS_KEY, each.encode())
        sha256 = hashlib.sha256(b"".join(each.encode() for each in made)).hexdigest()
        of = {"space": "B", "dim": 3, "first": first, "end": first + 3, "detections": 10}
        command = Reembed(command_id="r", issued_by="me", sha256=sha256, **of)
        writer.append(COMMAND_KEY, encode_command(command))
    shown = ("state", "log", "--json", "--set", "embedding_model=B")
    run("edit", "log", "drop-detection", *people, "--reason", "forgotten first")
    before = run(*shown).json
    run("log", "redact", "log", "--class", "person", *WHO)
    after = run(*shown).json
    assert [before[name] for name in ("digest", "objects", "keyframes")] == [
        after[name] for name in ("digest", "objects", "keyframes")
    ]
    gone = [np.array(vectors[name], "<f4").tobytes() for name in people]
    gone.append(np.array([9.0, 8.0, 7.0], "<f4").tobytes())
    assert holds(log, [part for raw in gone for part in (raw, base64.b64encode(raw))]) == []
    assert verify_log(log).findings == ()


def _rows(vectors: dict[DetId, list[float]], names: list[DetId]) -> Any:
    import numpy as np

    return np.array([vectors[name] for name in names], np.float32)


def test_messages_of_ros_that_may_show_it_go_with_their_recording(tmp_path: Path) -> None:
    run, log = Commands.in_folder(tmp_path), tmp_path / "log"
    forms = {
        "/detections": "vision_msgs/msg/Detection2DArray",
        "/tf": "tf2_msgs/msg/TFMessage",
        "/image": "sensor_msgs/msg/Image",
    }
    with LogWriter(log) as writer:
        for number, name in enumerate(("home", "guest", "other")):
            streams = (Stream("/detections", name),)
            writer.append(ROS_KEY, RosRecording(key=KEY, streams=streams).encode())
            for topic, schema in forms.items():
                form = CROP_FORMAT._replace(schema=schema)
                writer.append(topic, f"{topic} of {name}".encode(), form=form)
            writer.append(KEY, payload(seen(number, run=name)))  # the first has a person
    before = read_log(log)
    run("log", "redact", "log", "--class", "person", *WHO)
    gone = [e.key for e, now in zip(before, read_log(log), strict=False) if now.key == REDACTED_KEY]
    assert gone == ["/detections", "/image"]
    assert holds(log, [b"/detections of home", b"/image of home"]) == []
    assert {n for _, n in holds(log, [b"/tf of home", b"/image of guest"])} == {
        b"/tf of home",
        b"/image of guest",
    }
    run("log", "redact", "log", "--run", "guest", *WHO)
    assert holds(log, [f"{topic} of guest".encode() for topic in forms]) == []
    assert verify_log(log).findings == ()


def test_databases_that_are_due_are_not_forgotten(run: Commands, tmp_path: Path) -> None:
    """Neither by --resume, nor by the next redaction or recorder."""
    db = ("--db", "postgresql://me:hunter2@127.0.0.1:1/house")
    failed = run("log", "redact", "log", "--class", "person", *WHO, *db, code=1).err
    assert "127.0.0.1" in failed
    for words in (("--resume",), ("--class", "cup", *WHO)):
        with LogWriter(tmp_path / "log"):  # a recorder between
            pass
        said = run("log", "redact", "log", *words, code=1).err
        assert "--resume --db postgresql://me@127.0.0.1:1/house" in said
    assert holds(tmp_path, [b"hunter2"]) == []
    assert "not finished" in run("log", "verify", "log", code=3).out


def test_a_redaction_that_cannot_be_read_is_not_taken_for_none(
    run: Commands, tmp_path: Path
) -> None:
    log, url = tmp_path / "log", f"file://{tmp_path}/archive"
    run("log", "archive", "log", url)
    run("log", "redact", "log", "--class", "person", *WHO)
    with LogWriter(log) as writer:
        writer.append(REDACTION_KEY, b"{}")
    assert "redactions cannot be read" in run("log", "archive", "log", url, code=1).err
    with Redactor(log) as redactor, pytest.raises(LogDamaged, match="does not say what was"):
        redactor.stage(lambda _: None, b"salt")
