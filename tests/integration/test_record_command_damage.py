"""`mapfold record` on full disks, damaged logs and logs of killed writers."""

import json
import os
import random
import resource
import signal
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from eventsrc.log import LogReader, LogWriter
from eventsrc.log.format import LEDGER, SEALED_END
from eventsrc.record.append import append_payload
from eventsrc.record.robot.acks import Ack, ack_key, payload_sha256
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, Session, ZenohOptions
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, NEVER_S, Program

Start = Callable[..., Program]


Sessions = Callable[[], Session]


_ON_A_SMALL_DISK = """
import resource, sys
from projections.surfaces.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
main()
"""


@pytest.mark.parametrize("fsync", ["always", "50ms"])
def test_a_full_disk_is_one_line_and_what_is_synced_stays(
    start_code: Start, endpoint: str, connected: Sessions, tmp_path: Path, fsync: str
) -> None:
    """A limit on the size of files is the disk here: some of 20 envelopes fit."""
    log = tmp_path / "log"
    acked: set[str] = set()
    heard = threading.Event()

    def hear(message: Received) -> None:
        acked.update(Ack.decode(message.payload).sha256)
        if len(acked) >= 3:
            heard.set()

    watcher = connected()
    watcher.subscribe(ack_key("run-a"), hear)
    watcher.confirm()
    arguments = ("record", str(log), "--connect", endpoint, "--fsync", fsync, "--json")
    recorder = start_code(_ON_A_SMALL_DISK, *arguments)
    recorder.wait_for("recording")
    publisher = connected().publisher(KEY)
    assert publisher.wait_for_subscriber(DEADLINE_S)
    sent = [payload(envelope(k, note="x" * 10_000)) for k in range(20)]
    for message in sent[:3]:
        publisher.put(message)
    assert heard.wait(DEADLINE_S)
    for message in sent[3:]:
        publisher.put(message)
    assert recorder.wait() == 1
    line = recorder.lines[-1]
    assert line.startswith(f"mapfold: {log}")
    assert "File too large" in line
    assert "every event before it is safe" in line
    assert not any("Traceback" in said for said in recorder.lines)
    stored = [event.payload for event in read_log(log)]
    assert stored == sent[: len(stored)]
    assert acked <= set(map(payload_sha256, stored))
    numbers = json.loads(recorder.output())
    assert numbers["recorded"] == numbers["next_offset"] == len(stored)
    assert 0 < numbers["unwritten"] <= len(sent) - len(stored)
    lost, summary = recorder.lines[-3:-1]
    assert lost.startswith(f"LOST {numbers['unwritten']} message")
    assert f"{len(stored)} recorded, 0 rejected, {numbers['unwritten']} lost" in summary


def test_a_failing_seal_is_reported_with_the_numbers(
    start: Start, endpoint: str, connected: Sessions, tmp_path: Path
) -> None:
    """The disk fills up when all is synced: there is no room for the sealed segment."""
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--fsync", "always", "--json")
    recorder.wait_for("recording")
    covered = threading.Event()
    watcher = connected()
    watcher.subscribe(ack_key("run-a"), lambda said: covered.set())
    watcher.confirm()
    publisher = connected().publisher(KEY)
    assert publisher.wait_for_subscriber(DEADLINE_S)
    noise = random.Random(1).randbytes(50_000).hex()
    publisher.put(payload(envelope(1, note=noise)))
    assert covered.wait(DEADLINE_S)
    resource.prlimit(recorder.process.pid, resource.RLIMIT_FSIZE, (20_000, 20_000))
    assert recorder.end(signal.SIGINT) == 1
    numbers = json.loads(recorder.output())
    assert (numbers["recorded"], numbers["unwritten"], numbers["unsealed"]) == (1, 0, 1)
    assert "could not be sealed: File too large" in numbers["sealing_error"]
    assert recorder.lines[-1] == f"mapfold: {numbers['sealing_error']}"
    assert len(read_log(log)) == 1


@pytest.mark.slow
def test_a_segment_that_is_cut_short_is_reported_and_recording_goes_on(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--fsync", "always", "--json")
    recorder.wait_for("recording")
    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool", resend_after_s=NEVER_S) as robot:
        for k in range(5):
            robot.publish(envelope(k))
        assert robot.flush(DEADLINE_S)
        (active,) = log.glob("*.active")
        os.truncate(active, 0)
        for k in range(5, 9):
            robot.publish(envelope(k))
        assert robot.flush(DEADLINE_S)
    said = recorder.wait_for("SEGMENT GIVEN UP")
    assert f"{active} was cut short to 0 of" in said
    assert "offsets 0 to 4, which had been recorded in it, are lost" in said
    assert recorder.end(signal.SIGINT) == 1
    numbers = json.loads(recorder.output())
    assert (numbers["recorded"], numbers["lost_from_log"], numbers["next_offset"]) == (9, 5, 9)
    assert "mapfold log recover" in recorder.lines[-1]
    with LogReader(log) as reader:
        assert [e.payload for e in reader.read(5)] == [payload(envelope(k)) for k in range(5, 9)]
    assert not (log / LEDGER).exists(), "it would know keyframes that the log has lost"


def _leave_torn(log: Path) -> None:
    """What a recorder leaves that is killed in the middle of writing its fourth event."""
    last = payload(envelope(3))
    with LogWriter(log) as writer:
        for k in range(4):
            append_payload(writer, KEY, payload(envelope(k)))
            writer.sync()
        (active,) = log.glob("*.active")
        whole = active.read_bytes()
    (sealed,) = log.glob("*.mcap")
    sealed.unlink()
    (log / SEALED_END).unlink()
    active.write_bytes(whole[: whole.index(last) + 20])


@pytest.mark.parametrize("command", ["record", "import"])
def test_what_a_killed_writer_left_is_reported(
    start: Start, endpoint: str, tmp_path: Path, command: str
) -> None:
    log, nothing = tmp_path / "log", tmp_path / "nothing.jsonl"
    nothing.touch()
    _leave_torn(log)
    if command == "record":
        program = start("record", str(log), "--connect", endpoint, "--json")
        program.wait_for("from offset 3")
        assert program.end(signal.SIGINT) == 0
    else:
        program = start("import", str(log), str(nothing), "--json")
        assert program.wait() == 0
    numbers = json.loads(program.output())
    assert (numbers["recovered_segments"], numbers["recovered_events"]) == (1, 3)
    assert (numbers["torn_bytes"] > 20, numbers["torn_events"]) == (True, 1)
    assert program.lines[0] == (
        f"{log}: the last writer did not finish; recovered 1 segment with 3 events, cut off "
        f"{numbers['torn_bytes']} torn bytes with 1 event that were never recorded"
    )


def test_a_place_where_no_log_can_be_is_one_line(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    recorder = start("record", str(tmp_path / "file" / "log"), "--connect", endpoint)
    assert recorder.wait() in (1, 2)
    (line,) = recorder.lines
    assert str(tmp_path / "file") in line


def test_recording_goes_on_without_gap_history_when_an_old_segment_is_damaged(
    start: Start, publish: Start, endpoint: str, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    with LogWriter(log) as writer:
        for k in range(3):
            noise = random.Random(k).randbytes(20_000).hex()  # so that the middle is a payload
            append_payload(writer, KEY, payload(envelope(k, note=noise)))
    (segment,) = log.glob("*.mcap")
    rotten = bytearray(segment.read_bytes())
    rotten[len(rotten) // 2] ^= 0xFF
    segment.write_bytes(rotten)
    recorder = start("record", str(log), "--connect", endpoint)
    recorder.wait_for("recording without gap history")
    recorder.wait_for("from offset 3")
    assert publish(KEY, payload(envelope(3)).decode()).wait() == 0
    assert recorder.end(signal.SIGINT) == 0
    assert "1 recorded" in recorder.lines[-1]
    assert not (log / LEDGER).exists()
