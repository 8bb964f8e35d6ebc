"""The recorder on a real router, a real log and, mostly, a publisher in another process."""

import itertools
import json
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest
import zenoh

from eventsrc.append import append_payload
from eventsrc.clock import system_clock
from eventsrc.errors import LogDamaged, LogError, MisuseError
from eventsrc.gap_history import ledger_of, save_ledger
from eventsrc.gaps import DEFAULT_SETTLE_NS, Gap
from eventsrc.log import Event, FsyncPolicy, LogReader, LogWriter
from eventsrc.recorder import Recorder, RecorderReport
from eventsrc.recorder.checking import Batch, Checker
from eventsrc.recorder.queue import MessageQueue, SequenceGaps
from eventsrc.recorder.writer_thread import WriterThread
from eventsrc.robot.acks import (
    MAX_PER_ACK,
    MAX_SENT_BYTES,
    Ack,
    Refusal,
    Refusals,
    Sent,
    ack_key,
    payload_sha256,
    refusal_key,
    sent_key,
)
from eventsrc.system_events import LOSS_KEY, REJECTED_KEY, Loss, RejectedPayload
from eventsrc.transport.session import Received, Router, Session, ZenohOptions, open_session
from tests.envelopes import detection, envelope, payload
from tests.fixtures_log import flip
from tests.fixtures_zenoh import DEADLINE_S, LOOPBACK, Program
from tests.recorders import Running
from tests.thorough import rounds

Sessions = Callable[[], Session]
KEY = "tb/detections"
SETTLE_NS = rounds(DEFAULT_SETTLE_NS, DEFAULT_SETTLE_NS // 20)
"""How long a gap is open before it counts, in tests that wait for it."""


@contextmanager
def recording(
    session: Session,
    log: Path,
    keys: Sequence[str] = (KEY,),
    queue_size: int = 1_000,
    settle_ns: int = DEFAULT_SETTLE_NS,
) -> Iterator[Running]:
    with LogWriter(log) as writer:
        with LogReader(log) as reader:
            ledger = ledger_of(reader, settle_ns=settle_ns)
        running = Running(Recorder(session, writer, keys, queue_size=queue_size, ledger=ledger))
        try:
            yield running
        finally:
            running._stop.set()
            running._thread.shutdown()


def _events(log: Path) -> list[Event]:
    with LogReader(log) as reader:
        return list(reader.read())


def _keyframes(*keyframe_ids: int, **fields: object) -> list[bytes]:
    return [payload(envelope(k, **fields)) for k in keyframe_ids]


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
    events = _events(tmp_path / "log")
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
    rejected, accepted = _events(tmp_path / "log")
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
    assert {e.key for e in _events(tmp_path / "log")} == {
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
    (event,) = _events(tmp_path / "log")
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
    sent = [*_keyframes(*range(600), run_id=run_id), *_keyframes(1, 2, run_id=run_id, note="b")]
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
        for message in _keyframes(1, 2, note="x" * 1000):
            append_payload(writer, KEY, message)
    with LogReader(log) as reader:
        save_ledger(log, reader.log_id, reader.next_offset, ledger_of(reader))
    (segment,) = log.glob("*.mcap")
    flip(segment, segment.read_bytes().index(b"zstd") + 100)
    with pytest.raises(LogDamaged):
        _events(log)
    acks: list[Ack] = []
    acked = threading.Event()

    def hear(message: Received) -> None:
        acks.append(Ack.decode(message.payload))
        acked.set()

    watcher = connected()
    watcher.subscribe(ack_key("run-a"), hear)
    watcher.confirm()
    (message,) = _keyframes(3)
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
        kept = (RejectedPayload.model_validate_json(e.payload) for e in _events(log))
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


def test_messages_lost_in_a_full_queue_are_counted_and_recorded(
    connected: Sessions, tmp_path: Path
) -> None:
    """The clock is the gate: the writer stands in its first append until the gate opens."""
    entered, gate = threading.Event(), threading.Event()
    gate.set()

    def gated_clock() -> int:
        entered.set()
        assert gate.wait(DEADLINE_S)
        return system_clock()

    publisher = connected().publisher(KEY)
    with LogWriter(tmp_path / "log", clock=gated_clock) as writer:
        running = Running(Recorder(connected(), writer, [KEY], queue_size=4))
        assert publisher.wait_for_subscriber(DEADLINE_S)
        gate.clear()
        entered.clear()
        messages = _keyframes(*range(12))
        publisher.put(messages[0])
        assert entered.wait(DEADLINE_S)
        for message in messages[1:]:
            publisher.put(message)
        running.wait_until(lambda report: report.queue_full == 7)
        gate.set()
        running.wait_until(lambda report: report.recorded == 5)
        publisher.put(payload(envelope(12)))
        running.wait_until(lambda report: report.recorded == 6)
        report = running.finish()
    assert not report.clean
    assert (report.lost, report.missing) == (7, 7)
    events = _events(tmp_path / "log")
    assert [e.payload for e in events if e.key == KEY] == [
        *messages[:5],
        payload(envelope(12)),
    ]
    losses = [Loss.model_validate_json(e.payload) for e in events if e.key == LOSS_KEY]
    assert sum(loss.count for loss in losses if loss.cause == "queue_full") == 7
    assert Loss(publisher="run-a", first=5, last=11, count=7, cause="keyframe_gap") in losses


def _losses(log: Path) -> list[Loss]:
    return [Loss.model_validate_json(e.payload) for e in _events(log) if e.key == LOSS_KEY]


def test_gaps_in_sequence_numbers_are_recorded_as_losses(
    connected: Sessions, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The numbers of an advanced publisher are put on by hand, so that some can be left out; and
    so is its heartbeat, which tells that there were two more."""
    monkeypatch.setattr(SequenceGaps.__init__, "__defaults__", (SETTLE_NS,))
    with recording(connected(), tmp_path / "log") as running:
        robot = connected()
        publisher = robot.raw.declare_publisher(KEY)
        for number in (0, 1, 4, 5, 9):
            robot.raw.put(
                KEY,
                payload(envelope(number)),
                congestion_control=zenoh.CongestionControl.BLOCK,
                source_info=zenoh.SourceInfo(publisher.id, number),
            )
        running.wait_until(lambda report: report.recorded == 5)  # a heartbeat may overtake them
        source = f"{publisher.id.zid}/{publisher.id.eid}"
        robot.publisher(f"{KEY}/@adv/pub/{source}/_").put((11).to_bytes(4, "little"))
        running.wait_until(lambda report: report.transport_missed == 7)
        assert not running.finish().clean
    losses = _losses(tmp_path / "log")
    missed = [loss for loss in losses if loss.cause == "transport_miss"]
    assert [(x.first, x.last, x.count) for x in missed] == [(2, 3, 2), (6, 8, 3), (10, 11, 2)]
    assert {loss.publisher for loss in missed} == {source.replace("/", ":")}
    assert [(x.first, x.last) for x in losses if x.cause == "keyframe_gap"] == [(2, 3), (6, 8)]


def test_an_announcement_reveals_that_the_last_keyframes_are_missing(
    connected: Sessions, tmp_path: Path
) -> None:
    """The words of a publisher of ours, without the messages. What it says is nothing to record."""
    log = tmp_path / "log"
    with recording(connected(), log, ["tb/*"], settle_ns=SETTLE_NS) as running:
        robot = connected()
        publisher, teller = robot.publisher(KEY), robot.publisher(sent_key(KEY))
        assert publisher.wait_for_subscriber(DEADLINE_S)
        for message in _keyframes(1, 2):
            publisher.put(message)
        running.wait_until(lambda report: report.recorded == 2)
        for said in (b"nonsense", b"{" * MAX_SENT_BYTES, b" " * (MAX_SENT_BYTES + 1)):
            teller.put(said)
        teller.put(Sent(run_id="run-a", last=5).encode())
        running.wait_until(lambda report: report.missing == 3)
        report = running.finish()
    assert (report.recorded, report.rejected, report.lost, report.clean) == (2, 0, 0, False)
    gap = Loss(publisher="run-a", first=3, last=5, count=3, cause="keyframe_gap")
    assert _losses(log) == [gap]
    with recording(connected(), log) as running:
        robot.publisher(KEY).put(*_keyframes(4))
        running.wait_until(lambda report: report.recorded == 1)
        assert running.finish().missing == 2
    assert _losses(log) == [gap], "one gap is reported once"


def test_an_older_form_is_recorded_and_counts_no_keyframes(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    bare = json.dumps([detection(class_name="cup")]).replace('"class"', '"class_name"')
    with recording(connected(), tmp_path / "log") as running:
        publish(KEY, bare, "not json", bare)
        running.wait_until(lambda report: (report.recorded, report.rejected) == (2, 1))
        assert running.finish().missing == 0
    assert [e.payload.decode() for e in _events(tmp_path / "log") if e.key == KEY] == [bare, bare]


def test_a_publisher_at_full_speed_is_slowed_down_and_loses_nothing(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    sent = [payload(envelope(k)).decode() for k in range(3_000)]
    with recording(connected(), tmp_path / "log", queue_size=8) as running:
        assert publish(KEY, *sent).wait() == 0
        running.wait_until(lambda report: report.recorded == len(sent))
        assert running.finish().clean
    assert [e.payload.decode() for e in _events(tmp_path / "log")] == sent


def test_a_gap_in_the_last_moment_is_written_before_the_end(
    connected: Sessions, tmp_path: Path
) -> None:
    """The group commit never comes due: what the last events tell is known only at the end."""
    lazy = FsyncPolicy(interval_ns=10**18)
    with LogWriter(tmp_path / "log", fsync=lazy) as writer:
        running = Running(Recorder(connected(), writer, [KEY]))
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        for message in _keyframes(1, 4, 2):
            publisher.put(message)
        running.wait_until(lambda report: report.next_offset == 3)
        report = running.finish()
    assert (report.recorded, report.missing) == (3, 1)
    assert [
        Loss.model_validate_json(event.payload)
        for event in _events(tmp_path / "log")
        if event.key == LOSS_KEY
    ] == [Loss(publisher="run-a", first=3, last=3, count=1, cause="keyframe_gap")]


def test_a_gap_between_two_recorders_is_found_and_a_late_keyframe_closes_it(
    connected: Sessions, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    publisher = connected().publisher(KEY)

    def record(*keyframe_ids: int) -> RecorderReport:
        with recording(connected(), log) as running:
            assert publisher.wait_for_subscriber(DEADLINE_S)
            for message in _keyframes(*keyframe_ids):
                publisher.put(message)
            running.wait_until(lambda report: report.recorded == len(keyframe_ids))
            return running.finish()

    assert record(1, 2).missing == 0
    assert record(6).missing == 3
    assert record(4).missing == 2
    losses = [Loss.model_validate_json(e.payload) for e in _events(log) if e.key == LOSS_KEY]
    assert losses == [Loss(publisher="run-a", first=3, last=5, count=3, cause="keyframe_gap")]
    with LogReader(log) as reader:
        assert list(ledger_of(reader).gaps()) == [Gap("run-a", 3, 3), Gap("run-a", 5, 5)]


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
        for message in _keyframes(1, 2, 3, 4, 5):
            publisher.put(message)
        assert running._done.result(DEADLINE_S).recorded == 3
        running.finish()
    assert len(_events(tmp_path / "log")) == 3


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
        first, *others = _keyframes(*range(11))
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
        messages = [Received(KEY, p) for p in _keyframes(*range(count), run_id=run_id)]
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
