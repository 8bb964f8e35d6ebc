"""What a recorder loses or never gets: full queues, and gaps in what robots count."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from eventsrc.base.machine import system_clock
from eventsrc.envelope.gaps import DEFAULT_SETTLE_NS, Gap
from eventsrc.envelope.system_events import LOSS_KEY, Loss
from eventsrc.log import FsyncPolicy, LogReader, LogWriter
from eventsrc.record.gap_history import ledger_of
from eventsrc.record.recorder.queue import SequenceGaps
from eventsrc.record.recorder.recorder import Recorder
from eventsrc.record.recorder.writer_thread import RecorderReport
from eventsrc.record.robot.acks import MAX_SENT_BYTES, Sent, sent_key
from eventsrc.record.transport.session import Session
from tests.support.envelopes import envelope, keyframe_payloads, payload
from tests.support.fixtures_log import KEY, read_log
from tests.support.fixtures_zenoh import DEADLINE_S, Program
from tests.support.recorders import Running, recording
from tests.support.thorough import rounds

Sessions = Callable[[], Session]


SETTLE_NS = rounds(DEFAULT_SETTLE_NS, DEFAULT_SETTLE_NS // 20)
"""How long a gap is open before it counts, in tests that wait for it."""


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
        messages = keyframe_payloads(*range(12))
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
    events = read_log(tmp_path / "log")
    assert [e.payload for e in events if e.key == KEY] == [
        *messages[:5],
        payload(envelope(12)),
    ]
    losses = [Loss.model_validate_json(e.payload) for e in events if e.key == LOSS_KEY]
    assert sum(loss.count for loss in losses if loss.cause == "queue_full") == 7
    assert Loss(publisher="run-a", first=5, last=11, count=7, cause="keyframe_gap") in losses


def _losses(log: Path) -> list[Loss]:
    return [Loss.model_validate_json(e.payload) for e in read_log(log) if e.key == LOSS_KEY]


@pytest.mark.slow
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
        for message in keyframe_payloads(1, 2):
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
        robot.publisher(KEY).put(*keyframe_payloads(4))
        running.wait_until(lambda report: report.recorded == 1)
        assert running.finish().missing == 2
    assert _losses(log) == [gap], "one gap is reported once"


def test_a_publisher_at_full_speed_is_slowed_down_and_loses_nothing(
    connected: Sessions, publish: Callable[..., Program], tmp_path: Path
) -> None:
    sent = [payload(envelope(k)).decode() for k in range(3_000)]
    with recording(connected(), tmp_path / "log", queue_size=8) as running:
        assert publish(KEY, *sent).wait() == 0
        running.wait_until(lambda report: report.recorded == len(sent))
        assert running.finish().clean
    assert [e.payload.decode() for e in read_log(tmp_path / "log")] == sent


def test_a_gap_in_the_last_moment_is_written_before_the_end(
    connected: Sessions, tmp_path: Path
) -> None:
    """The group commit never comes due: what the last events tell is known only at the end."""
    lazy = FsyncPolicy(interval_ns=10**18)
    with LogWriter(tmp_path / "log", fsync=lazy) as writer:
        running = Running(Recorder(connected(), writer, [KEY]))
        publisher = connected().publisher(KEY)
        assert publisher.wait_for_subscriber(DEADLINE_S)
        for message in keyframe_payloads(1, 4, 2):
            publisher.put(message)
        running.wait_until(lambda report: report.next_offset == 3)
        report = running.finish()
    assert (report.recorded, report.missing) == (3, 1)
    assert [
        Loss.model_validate_json(event.payload)
        for event in read_log(tmp_path / "log")
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
            for message in keyframe_payloads(*keyframe_ids):
                publisher.put(message)
            running.wait_until(lambda report: report.recorded == len(keyframe_ids))
            return running.finish()

    assert record(1, 2).missing == 0
    assert record(6).missing == 3
    assert record(4).missing == 2
    losses = [Loss.model_validate_json(e.payload) for e in read_log(log) if e.key == LOSS_KEY]
    assert losses == [Loss(publisher="run-a", first=3, last=5, count=3, cause="keyframe_gap")]
    with LogReader(log) as reader:
        assert list(ledger_of(reader).gaps()) == [Gap("run-a", 3, 3), Gap("run-a", 5, 5)]
