"""The recorder on a real router, a real log and, mostly, a publisher in another process."""

import itertools
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from eventsrc.base.errors import LogDamaged, LogError, MisuseError
from eventsrc.base.machine import system_clock
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload
from eventsrc.log import LogReader, LogWriter
from eventsrc.record.append import append_payload
from eventsrc.record.gap_history import ledger_of, save_ledger
from eventsrc.record.recorder.checking import Batch, Checker
from eventsrc.record.recorder.queue import MessageQueue
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.recorder.writer_thread import WriterThread
from eventsrc.record.robot.acks import (
    MAX_PER_ACK,
    Ack,
    Refusal,
    Refusals,
    ack_key,
    payload_sha256,
    refusal_key,
)
from eventsrc.record.transport.session import Received, Router, Session, ZenohOptions, open_session
from tests.support.envelopes import detection, envelope, keyframe_payloads, payload
from tests.support.fixtures_log import KEY, flip, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, LOOPBACK, Program
from tests.support.recorders import Running, recording

Sessions = Callable[[], Session]


def test_every_envelope_is_found_byte_for_byte(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    sent = [
        payload(envelope(k, detections=[detection("baker's rack 🧁", [1.0, 2.0], extra=k)]))
        for k in range(50)
    ]
    with recording(connected(), tmp_path / "log") as running:
        assert publish(KEY, *(p.decode() for p in sent)).wait() == 0
        running.wait_until(lambda report: report.recorded == 50)
        report = running.finish()
    assert report.clean
    assert report.next_offset == 50
    events = read_log(tmp_path / "log")
    assert [e.payload for e in events] == sent
    assert [e.offset for e in events] == list(range(50))
    assert {e.key for e in events} == {KEY}
    assert events[7].stamp_ns == 1_774_357_207_000_000_000


def test_a_payload_that_is_no_envelope_is_kept_with_its_reason(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    with recording(connected(), tmp_path / "log") as running:
        publish(KEY, "no json", payload(envelope(1)).decode())
        running.wait_until(lambda report: report.recorded == 1)
        report = running.finish()
    assert (report.recorded, report.rejected, report.clean) == (1, 1, False)
    rejected, accepted = read_log(tmp_path / "log")
    assert (rejected.key, accepted.key) == (REJECTED_KEY, KEY)
    kept = RejectedPayload.model_validate_json(rejected.payload)
    assert (kept.key, kept.raw) == (KEY, b"no json")
    assert "not JSON" in kept.reason


def test_wildcards_record_every_key_under_its_own_name(connected: Sessions, tmp_path: Path) -> None:
    with recording(connected(), tmp_path / "log", ["tb/*", "robots/**"]) as running:
        session = connected()
        for key in ("tb/detections", "tb/other", "robots/7/detections"):
            publisher = session.publisher(key)
            assert publisher.wait_for_subscriber(DEADLINE_S)
            publisher.put(payload(envelope(1, run_id=key)))
        running.wait_until(lambda report: report.recorded == 3)
        running.finish()
    assert {e.key for e in read_log(tmp_path / "log")} == {
        "tb/detections",
        "tb/other",
        "robots/7/detections",
    }


def test_system_events_cannot_be_forged_from_the_network(
    connected: Sessions, tmp_path: Path
) -> None:
    forged = Loss(publisher="run-a", count=5, cause="queue_full").model_dump_json().encode()
    with recording(connected(), tmp_path / "log", ["**"]) as running:
        publisher = connected().publisher(LOSS_KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(forged)
        running.wait_until(lambda report: report.rejected == 1)
        running.finish()
    (event,) = read_log(tmp_path / "log")
    assert event.key == REJECTED_KEY
    kept = RejectedPayload.model_validate_json(event.payload)
    assert (kept.key, kept.raw) == (LOSS_KEY, forged)
    assert "reserved" in kept.reason


def test_a_recorder_of_everything_does_not_record_its_own_acks(
    connected: Sessions, tmp_path: Path
) -> None:
    acked = threading.Event()
    watcher = connected()
    watcher.subscribe(ack_key("run-a"), lambda _: acked.set())
    watcher.confirm()
    with recording(connected(), tmp_path / "log", ["**"]) as running:
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(payload(envelope(1)))
        assert acked.wait(DEADLINE_S)
        publisher.put(payload(envelope(2)))
        running.wait_until(lambda report: report.recorded == 2)
        assert running.finish().rejected == 0


def test_an_ack_names_what_is_synced_and_nothing_else(connected: Sessions, tmp_path: Path) -> None:
    """More payloads than one ack names, and of each robot its own though they share a run."""
    run_id = "robot/*?#$ 🤖"
    acks: list[Ack] = []
    covered = threading.Event()
    sent = [
        *keyframe_payloads(*range(600), run_id=run_id),
        *keyframe_payloads(1, 2, run_id=run_id, note="b"),
    ]
    wanted = set(map(payload_sha256, sent))

    def hear(message: Received) -> None:
        acks.append(Ack.decode(message.payload))
        if {digest for ack in acks for digest in ack.sha256} >= wanted:
            covered.set()

    watcher = connected()
    watcher.subscribe(ack_key(run_id), hear)
    watcher.confirm()
    with recording(connected(), tmp_path / "log") as running:
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        for message in (b"no envelope", *sent):
            publisher.put(message)
        assert covered.wait(DEADLINE_S)
        running.finish()
    assert {(ack.run_id, ack.key) for ack in acks} == {(run_id, KEY)}
    assert {digest for ack in acks for digest in ack.sha256} == wanted
    assert max(len(ack.sha256) for ack in acks) <= MAX_PER_ACK
    with LogReader(tmp_path / "log") as reader:
        assert {ack.log_id for ack in acks} == {reader.log_id}


def test_an_ack_does_not_rest_on_what_an_earlier_recorder_synced(
    connected: Sessions, tmp_path: Path
) -> None:
    """Keyframe 1 rots in a sealed segment; the saved ledger still has it, and so has a robot."""
    log = tmp_path / "log"
    with LogWriter(log) as writer:
        for message in keyframe_payloads(1, 2, note="x" * 1000):
            append_payload(writer, KEY, message)
    with LogReader(log) as reader:
        save_ledger(log, reader.log_id, reader.next_offset, ledger_of(reader))
    (segment,) = log.glob("*.mcap")
    flip(segment, segment.read_bytes().index(b"zstd") + 100)
    with pytest.raises(LogDamaged):
        read_log(log)
    acks: list[Ack] = []
    acked = threading.Event()

    def hear(message: Received) -> None:
        acks.append(Ack.decode(message.payload))
        acked.set()

    watcher = connected()
    watcher.subscribe(ack_key("run-a"), hear)
    watcher.confirm()
    (message,) = keyframe_payloads(3)
    with recording(connected(), log) as running:
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(message)
        assert acked.wait(DEADLINE_S)
        running.finish()
    assert [ack.sha256 for ack in acks] == [(payload_sha256(message),)]


def test_a_refusal_follows_when_the_rejected_bytes_are_synced(
    connected: Sessions, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    in_the_log: list[list[bytes]] = []
    heard: list[Refusals] = []
    told = threading.Event()

    def hear(message: Received) -> None:
        heard.append(Refusals.decode(message.payload))
        kept = (RejectedPayload.model_validate_json(e.payload) for e in read_log(log))
        in_the_log.append([one.raw for one in kept])
        told.set()

    watcher = connected()
    watcher.subscribe(refusal_key(KEY), hear)
    watcher.confirm()
    with recording(connected(), log) as running:
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(b"no envelope, nor any run")
        assert told.wait(DEADLINE_S)
        running.finish()
    ((refusal,),) = (said.refused for said in heard)
    assert refusal == Refusal.of(b"no envelope, nor any run", refusal.reason)
    assert "not JSON" in refusal.reason
    assert in_the_log == [[b"no envelope, nor any run"]]
    with LogReader(log) as reader:
        assert heard[0].log_id == reader.log_id


def test_an_older_form_is_recorded_and_counts_no_keyframes(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    bare = json.dumps([detection(class_name="cup")]).replace('"class"', '"class_name"')
    with recording(connected(), tmp_path / "log") as running:
        publish(KEY, bare, "not json", bare)
        running.wait_until(lambda report: (report.recorded, report.rejected) == (2, 1))
        assert running.finish().missing == 0
    assert [e.payload.decode() for e in read_log(tmp_path / "log") if e.key == KEY] == [bare, bare]


def test_recording_goes_on_when_the_router_comes_back(tmp_path: Path) -> None:
    with Router(LOOPBACK) as router:
        options = ZenohOptions(connect=router.endpoints)
        recorder_session = open_session(options, mode="client")
        publisher_session = open_session(options, mode="client")
        publisher = publisher_session.publisher(KEY)
    with (
        recorder_session,
        publisher_session,
        recording_later(recorder_session, tmp_path / "log", router) as running,
    ):
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(payload(envelope(1)))
        running.wait_until(lambda report: report.recorded == 1)
        assert running.finish().clean


@contextmanager
def recording_later(session: Session, log: Path, gone: Router) -> Iterator[Running]:
    """A recorder that subscribes while its router is away, and then the router again."""
    with recording(session, log) as running, Router(ZenohOptions(listen=gone.endpoints)):
        yield running


def test_it_stops_after_max_events(connected: Sessions, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log") as writer:
        running = Running(Recorder(connected(), writer, [KEY], max_events=3))
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        for message in keyframe_payloads(1, 2, 3, 4, 5):
            publisher.put(message)
        assert running._done.result(DEADLINE_S).recorded == 3
        running.finish()
    assert len(read_log(tmp_path / "log")) == 3


def test_a_log_that_cannot_be_written_ends_the_recording(
    connected: Sessions, tmp_path: Path
) -> None:
    times = itertools.chain([system_clock()], itertools.repeat(-1))
    with LogWriter(tmp_path / "log", clock=lambda: next(times)) as writer:
        running = Running(Recorder(connected(), writer, [KEY]))
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        publisher.put(payload(envelope(1)))
        with pytest.raises(LogError, match="not nanoseconds"):
            running._done.result(DEADLINE_S)


def test_what_was_received_and_could_not_be_written_is_counted(
    connected: Sessions, tmp_path: Path
) -> None:
    """The clock is the gate, and what breaks the log: the first message stands before the log, ten
    in the queue, and then an impossible time comes."""
    entered, gate = threading.Event(), threading.Event()
    opening = [system_clock()] * 2  # the lock and the first segment
    times = itertools.chain(opening, itertools.repeat(-1))

    def breaking_clock() -> int:
        now_ns = next(times)
        if now_ns < 0:
            entered.set()
            assert gate.wait(DEADLINE_S)
        return now_ns

    publisher = connected().publisher(KEY)
    with LogWriter(tmp_path / "log", clock=breaking_clock) as writer:
        running = Running(Recorder(connected(), writer, [KEY]))
        assert publisher.wait_for_subscriber(DEADLINE_S)
        first, *others = keyframe_payloads(*range(11))
        publisher.put(first)
        assert entered.wait(DEADLINE_S)
        for message in others:
            publisher.put(message)
        running.wait_until(lambda report: report.queue_depth == 10)
        gate.set()
        with pytest.raises(LogError, match="not nanoseconds"):
            running._done.result(DEADLINE_S)
    report = running._recorder.report()
    assert (report.recorded, report.unwritten, report.lost, report.clean) == (0, 11, 11, False)


def test_events_lost_before_their_acknowledgement_are_not_acknowledged(tmp_path: Path) -> None:
    """The first group is processed only when the second has found the file deleted."""
    answered: list[tuple[str, bytes]] = []
    writer = LogWriter(tmp_path / "log")
    queue = MessageQueue()
    checker = Checker(queue, writer, max_payload_bytes=2**20, max_messages=None)
    thread = WriterThread(
        queue,
        writer,
        None,
        lambda key, said: answered.append((key, said)),
        max_events=None,
        report_gaps=True,
        max_payload_bytes=2**20,
    )
    for run_id, count in (("lost", 3), ("kept", 2)):
        messages = [Received(KEY, p) for p in keyframe_payloads(*range(count), run_id=run_id)]
        batch = Batch()
        batch.messages.extend(checker.check(messages))
        thread.append(batch)
        writer.sync()
        if run_id == "lost":
            next((tmp_path / "log").glob("*.active")).unlink()
    thread._process_synced()
    report = thread.report()
    assert (report.recorded, report.lost_from_log, report.clean) == (2, 3, False)
    assert {b"lost" in said for _, said in answered} == {False}
    assert len(answered) == 1
    with pytest.raises(LogError, match="was deleted"):
        writer.close()


@pytest.mark.parametrize("keys", [["tb/*", "tb/detections"], ["**", "a"], ["a", "a"]])
def test_overlapping_keys_are_refused(connected: Sessions, tmp_path: Path, keys: list[str]) -> None:
    with LogWriter(tmp_path / "log") as writer, pytest.raises(MisuseError, match="overlap"):
        Recorder(connected(), writer, keys)


def test_a_malformed_key_is_named(connected: Sessions, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log") as writer, pytest.raises(MisuseError, match="'tb//x'"):
        Recorder(connected(), writer, ["tb//x"])
