"""Hostile messages and keys: the recorder goes on, and nothing is dropped silently."""

import queue
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from eventsrc.base.errors import TransportError
from eventsrc.envelope.ingest import DEFAULT_MAX_PAYLOAD_BYTES
from eventsrc.envelope.system_events import EXCERPT_BYTES, REJECTED_KEY, RejectedPayload
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.record.append import append_payload
from eventsrc.record.log_info import log_info
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.robot.acks import Refusal, Refusals, payload_sha256, refusal_key
from eventsrc.record.transport.session import Received, Session
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_zenoh import DEADLINE_S
from tests.support.thorough import rounds

Sessions = Callable[[], Session]
LONG_KEYS = ("t/" + "é" * 11_000, "t/" + "k" * 22_000, "t/" + "k" * 60_000)

PANIC = """
import sys
from eventsrc.record.transport.session import ZenohOptions, open_session
from eventsrc.record.transport.declarations import transport_errors
from eventsrc.base.errors import TransportError

session = open_session(ZenohOptions(connect=(sys.argv[1],)), mode="client")
for _ in range(2):  # from the second on a lock of Zenoh's is poisoned
    try:
        with transport_errors("here"):
            session.raw.put("t/" + "k" * 70_000, b"")
    except TransportError as error:
        print(error)
session.close()
try:
    with transport_errors("here"):
        raise KeyboardInterrupt
except KeyboardInterrupt:
    print("interrupted")
"""


def test_keys_of_any_length_stop_no_recorder(connected: Sessions, tmp_path: Path) -> None:
    good = payload(envelope(1))
    heard: dict[str, Refusals] = {}
    all_heard = threading.Event()

    def hear(message: Received) -> None:
        heard[message.key] = Refusals.decode(message.payload)
        if len(heard) == len(LONG_KEYS):
            all_heard.set()

    robot = connected()
    for key in LONG_KEYS:
        robot.subscribe(refusal_key(key), hear)
    robot.confirm()
    with LogWriter(tmp_path / "log") as writer:
        recorder = Recorder(connected(), writer, ["**"], max_events=len(LONG_KEYS) + 1)
        # By default a busy session drops messages.
        for key in (*LONG_KEYS, "t/short"):
            robot.raw.put(key, good, congestion_control=zenoh.CongestionControl.BLOCK)
        report = recorder.run(threading.Event())
        assert all_heard.wait(DEADLINE_S)
    assert (report.recorded, report.rejected, report.lost) == (1, len(LONG_KEYS), 0)
    with LogReader(tmp_path / "log") as reader:
        rejected = [
            RejectedPayload.model_validate_json(event.payload)
            for event in reader.read(keys={REJECTED_KEY})
        ]
    assert {r.key for r in rejected} == set(LONG_KEYS)
    assert {r.raw for r in rejected} == {good}
    assert all(r.reason.endswith("bytes long, more than 1024") for r in rejected)
    assert all(len(r.reason) < 200 for r in rejected)
    assert verify_log(tmp_path / "log").findings == ()


def test_of_a_message_far_over_the_limit_an_excerpt_is_kept(
    connected: Sessions, tmp_path: Path
) -> None:
    """Its robot hears that it was refused, so it does not send it again."""
    most = 2 * DEFAULT_MAX_PAYLOAD_BYTES
    large = [b"%d " % size + bytes(size) for size in (most, 2 * most)]
    robot, refused = connected(), queue.SimpleQueue[Refusal]()
    robot.subscribe(
        refusal_key("t/a"), lambda m: [*map(refused.put, Refusals.decode(m.payload).refused)]
    )
    robot.confirm()
    with LogWriter(tmp_path / "log") as writer:
        recorder = Recorder(
            connected(), writer, ["t/**"], max_events=4, max_payload_bytes=1_000, report_gaps=False
        )
        publisher = robot.publisher("t/a")  # one that blocks: Zenoh's own default drops
        for message in (*large, bytes(2_000), payload(envelope(1))):
            publisher.put(message)
        report = recorder.run(threading.Event())
        told = {one.sha256: one.size for one in (refused.get(timeout=DEADLINE_S) for _ in range(3))}
    assert (report.recorded, report.rejected, report.lost, report.clean) == (1, 3, 0, False)
    assert told.items() >= {(payload_sha256(one), len(one)) for one in large}
    with LogReader(tmp_path / "log") as reader:
        rejected = [
            RejectedPayload.model_validate_json(event.payload)
            for event in reader.read(keys={REJECTED_KEY})
        ]
    kept = {(one.sha256, one.size, one.raw) for one in rejected if one.sha256 is not None}
    assert kept == {(payload_sha256(one), len(one), one[:EXCERPT_BYTES]) for one in large}
    assert {one.key for one in rejected} == {"t/a"}
    assert all(
        f"more than the {most:,} that are kept" in one.reason for one in rejected if one.size
    )
    assert log_info(tmp_path / "log").lost == 0


def test_keys_that_make_zenoh_panic_are_not_sent(connected: Sessions) -> None:
    session = connected()
    for send in (lambda key: session.send(key, b""), session.publisher):
        with pytest.raises(TransportError, match=r"key 'kkk.*20,000 bytes are more than 16,384"):
            send("k" * 20_000)  # type: ignore[operator]


def test_a_panic_of_zenoh_is_a_transport_error(endpoint: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PANIC, endpoint],
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    *panics, last = done.stdout.splitlines()
    assert len(panics) == 2
    assert all(line.startswith("here: Zenoh panicked: ") for line in panics)
    assert last == "interrupted"


def test_a_lone_surrogate_in_a_key_is_escaped(tmp_path: Path) -> None:
    """From a file: Zenoh's own keys are UTF-8."""
    with LogWriter(tmp_path / "log") as writer:
        append_payload(writer, "t/\ud800", payload(envelope(1)))
    with LogReader(tmp_path / "log") as reader:
        (event,) = reader.read()
    record = RejectedPayload.model_validate_json(event.payload)
    assert record.key == r"t/\ud800"
    assert record.reason == r"key 't/\ud800' is no UTF-8"


@pytest.mark.slow
def test_thousands_of_keys_go_into_several_segments(tmp_path: Path) -> None:
    """MCAP counts channels in 16 bits, and a segment repeats all their names at its end."""
    most, keys = 4_096, [f"robot/{number}" for number in range(rounds(10_000, 5_000))]
    with LogWriter(tmp_path / "log") as writer:
        for key in keys:
            writer.append(key, b"{}")
    with LogReader(tmp_path / "log") as reader:
        assert [event.key for event in reader.read()] == keys
        counts = [len(reader.open_segment(entry).channels) for entry in reader.segments]  # type: ignore[union-attr]
    assert len(counts) == rounds(3, 2)
    assert max(counts) < most + 256
