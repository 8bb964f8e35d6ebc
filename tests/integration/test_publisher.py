"""The robot's publisher against real routers and recorders, with both of them going away."""

import json
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.robot.acks import Ack, Sent, ack_key, payload_sha256, sent_key
from eventsrc.record.robot.publisher import EnvelopePublisher
from eventsrc.record.transport.session import Received, Router, Session, ZenohOptions
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.fixtures_zenoh import DEADLINE_S, LOOPBACK, Program
from tests.support.recorders import encoded_ack, keyframe_ids, robot_at, stored_payloads
from tests.support.thorough import rounds

KEYFRAMES = rounds(6_000, 2_500)


Sessions = Callable[[], Session]
Start = Callable[..., Program]


@pytest.fixture
def robot(endpoint: str, tmp_path: Path) -> Iterator[EnvelopePublisher]:
    with robot_at(endpoint, tmp_path) as publisher:
        yield publisher


@pytest.fixture
def recorder(start: Start, endpoint: str, tmp_path: Path) -> Callable[[], Program]:
    def run() -> Program:
        program = start("record", str(tmp_path / "log"), "--connect", endpoint)
        program.wait_for("recording")
        return program

    return run


def test_what_is_acknowledged_is_in_the_log(
    robot: EnvelopePublisher, recorder: Callable[[], Program], tmp_path: Path
) -> None:
    recorder()
    sent = [payload(envelope(k)) for k in range(200)]
    for message in sent:
        robot.publish(message)
    assert robot.flush(DEADLINE_S)
    assert robot.unacknowledged == 0
    assert stored_payloads(tmp_path / "log") == sent


def test_robot_and_recorder_may_share_a_namespace(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    config = tmp_path / "zenoh.json5"
    config.write_text('{namespace: "building-1"}')
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--zenoh-config", str(config))
    recorder.wait_for("recording")
    options = ZenohOptions(connect=(endpoint,), config_file=config)
    with EnvelopePublisher(options, tmp_path / "spool.sqlite") as robot:
        robot.publish(envelope(1))
        assert robot.flush(DEADLINE_S)
    assert stored_payloads(log) == [payload(envelope(1))]


def test_a_dictionary_is_published_as_json(
    robot: EnvelopePublisher, recorder: Callable[[], Program], tmp_path: Path
) -> None:
    recorder()
    robot.publish(envelope(1, run_id="Küche 🤖"))
    assert robot.flush(DEADLINE_S)
    assert stored_payloads(tmp_path / "log") == [payload(envelope(1, run_id="Küche 🤖"))]


def test_it_starts_without_a_router_and_sends_when_there_is_one(
    start: Start, tmp_path: Path
) -> None:
    with Router(LOOPBACK) as gone:
        (endpoint,) = gone.endpoints
    with EnvelopePublisher(ZenohOptions(connect=(endpoint,)), tmp_path / "spool") as robot:
        for k in range(10):
            robot.publish(envelope(k))
        assert not robot.flush(0.01)
        with Router(ZenohOptions(listen=(endpoint,))):
            start("record", str(tmp_path / "log"), "--connect", endpoint)
            assert robot.flush(DEADLINE_S)
    assert stored_payloads(tmp_path / "log") == [payload(envelope(k)) for k in range(10)]


def test_envelopes_spooled_by_an_earlier_process_are_sent(
    endpoint: str, recorder: Callable[[], Program], tmp_path: Path
) -> None:
    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool") as robot:
        robot.publish(envelope(1))
        assert robot.close() == 1
        assert robot.close() == 1
    recorder()
    with EnvelopePublisher(options, tmp_path / "spool") as robot:
        assert robot.flush(DEADLINE_S)
    assert stored_payloads(tmp_path / "log") == [payload(envelope(1))]


def test_it_sends_again_until_a_recorder_answers(
    robot: EnvelopePublisher, connected: Sessions, recorder: Callable[[], Program], tmp_path: Path
) -> None:
    """Somebody listens who never acknowledges; what they got twice was sent again."""
    twice = threading.Semaphore(0)
    viewer = connected()
    viewer.subscribe(KEY, lambda _: twice.release())
    viewer.confirm()
    robot.publish(envelope(1))
    assert twice.acquire(timeout=DEADLINE_S)
    assert twice.acquire(timeout=DEADLINE_S)
    assert robot.unacknowledged == 1
    recorder()
    assert robot.flush(DEADLINE_S)
    assert stored_payloads(tmp_path / "log") == [payload(envelope(1))]


def test_at_most_a_window_is_in_transit(endpoint: str, connected: Sessions, tmp_path: Path) -> None:
    """The viewer never acknowledges: until the first comes again, it has seen the window alone."""
    seen: list[int] = []
    again, more = threading.Event(), threading.Event()

    def see(message: Received) -> None:
        seen.append(json.loads(message.payload)["keyframe_id"])
        if seen.count(0) == 2:
            again.set()
        if 14 in seen:
            more.set()

    viewer = connected()
    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool", window=10, resend_after_s=0.2) as robot:
        for k in range(50):
            robot.publish(envelope(k))
        viewer.subscribe(KEY, see)  # when the window is there to be sent at once
        assert again.wait(DEADLINE_S)
        assert seen[:11] == [*range(10), 0]
        viewer.send(ack_key("run-a"), encoded_ack(*(payload(envelope(k)) for k in range(5))))
        assert more.wait(DEADLINE_S)
        assert max(seen) <= 14


def test_lost_envelopes_do_not_fill_the_window(
    endpoint: str, connected: Sessions, tmp_path: Path
) -> None:
    """The first nine of a window of ten get no ack: they come again while the rest goes on."""
    viewer = connected()
    seen: list[int] = []
    again = threading.Event()

    def acknowledge(message: Received) -> None:
        seen.append(json.loads(message.payload)["keyframe_id"])
        if seen[-1] >= 9 or seen.count(8) > 1:
            viewer.send(ack_key("run-a"), encoded_ack(message.payload))
        if seen.count(8) > 1:
            again.set()

    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool", window=10, resend_after_s=0.5) as robot:
        for k in range(20):
            robot.publish(envelope(k))
        viewer.subscribe(KEY, acknowledge)  # when the window is there to be sent at once
        while not again.is_set():  # so that there is always an ack of a younger one
            k += 1
            robot.publish(envelope(k))
            again.wait(0.01)
            assert k < 100 * DEADLINE_S
        second = seen.index(8, seen.index(8) + 1)
        assert max(seen[:second]) > 9, "others were acknowledged before"


def test_two_robots_get_their_own_acks(
    endpoint: str, recorder: Callable[[], Program], tmp_path: Path
) -> None:
    recorder()
    options = ZenohOptions(connect=(endpoint,))
    with (
        EnvelopePublisher(options, tmp_path / "a") as one,
        EnvelopePublisher(options, tmp_path / "b") as other,
    ):
        for k in range(20):
            one.publish(envelope(k, run_id="run-a"))
            other.publish(envelope(k + 1_000, run_id="run-b"))
        assert one.flush(DEADLINE_S)
        assert other.flush(DEADLINE_S)
    assert keyframe_ids(tmp_path / "log") == {*range(20), *range(1_000, 1_020)}


def test_a_run_id_used_by_two_robots_acknowledges_to_each_its_own(
    endpoint: str, connected: Sessions, start: Start, tmp_path: Path
) -> None:
    """One publishes under a key that is not recorded; the other's acks are heard by both."""
    program = start("record", str(tmp_path / "log"), "--connect", endpoint)
    program.wait_for("recording")
    arrived = threading.Semaphore(0)
    viewer = connected()
    viewer.subscribe("tb/elsewhere", lambda _: arrived.release())
    viewer.confirm()
    options = ZenohOptions(connect=(endpoint,))
    with (
        EnvelopePublisher(options, tmp_path / "a") as one,
        EnvelopePublisher(options, tmp_path / "b", "tb/elsewhere", resend_after_s=0.1) as other,
    ):
        for k in range(20):
            other.publish(envelope(k, note="the other's"))
        other.publish(envelope(99))
        for _ in range(21):
            assert arrived.acquire(timeout=DEADLINE_S)
        for k in range(100):
            one.publish(envelope(k))
        assert one.flush(DEADLINE_S)
        assert arrived.acquire(timeout=DEADLINE_S), "sent again after that"
        assert other.unacknowledged == 21
    assert keyframe_ids(tmp_path / "log") == set(range(100))


def test_a_router_that_comes_and_goes_loses_nothing(start: Start, tmp_path: Path) -> None:
    """Robot and recorder stay; the router between them is restarted while the robot publishes."""
    log = tmp_path / "log"
    with Router(LOOPBACK) as router:
        (endpoint,) = router.endpoints
        robot = EnvelopePublisher(
            ZenohOptions(connect=(endpoint,)), tmp_path / "spool", resend_after_s=0.5
        )
        recorder = start("record", str(log), "--connect", endpoint)
        recorder.wait_for("recording")
        for k in range(500):
            robot.publish(envelope(k))
        assert robot.flush(DEADLINE_S)
        for k in range(500, 1_000):
            robot.publish(envelope(k))
    for k in range(1_000, 1_500):
        robot.publish(envelope(k))
    assert robot.unacknowledged >= 500
    with robot, Router(ZenohOptions(listen=(endpoint,))):
        assert robot.flush(DEADLINE_S)
        assert recorder.end(signal.SIGINT) in (0, 3)
    assert keyframe_ids(log) == set(range(1_500))


@pytest.mark.slow
def test_a_recorder_stopped_until_its_router_disconnects_it_loses_nothing(
    robot: EnvelopePublisher,
    connected: Sessions,
    recorder: Callable[[], Program],
    tmp_path: Path,
) -> None:
    """Some ten seconds; what is sent meanwhile is dropped by the router and comes again."""
    program = recorder()
    watch = connected().publisher(KEY)
    robot.publish(envelope(0))
    assert robot.flush(DEADLINE_S)
    program.process.send_signal(signal.SIGSTOP)
    for k in range(1, 3_000):
        robot.publish(envelope(k, note="x" * 10_000))
    viewer = connected()
    while watch.has_subscriber:
        viewer.confirm()
    program.process.send_signal(signal.SIGCONT)
    assert robot.flush(2 * DEADLINE_S)
    assert program.end(signal.SIGINT) in (0, 3)
    assert keyframe_ids(tmp_path / "log") == set(range(3_000))
    assert "0 keyframes missing" in program.lines[-1]


def test_an_ack_after_the_recorder_has_unsubscribed_is_applied(
    robot: EnvelopePublisher, connected: Sessions
) -> None:
    """As a recorder leaves it unsubscribes, syncs what it has, and acknowledges that."""
    arrived = threading.Semaphore(0)
    recorder = connected()
    subscription = recorder.subscribe(KEY, lambda _: arrived.release())
    recorder.confirm()
    for k in range(10):
        robot.publish(envelope(k))
    for _ in range(10):
        assert arrived.acquire(timeout=DEADLINE_S)
    subscription.close()
    viewer = connected()
    watch = viewer.publisher(KEY)
    while watch.has_subscriber:
        viewer.confirm()
    recorder.send(ack_key("run-a"), encoded_ack(*(payload(envelope(k)) for k in range(10))))
    assert robot.flush(DEADLINE_S)


def test_progress_is_published_and_once_more_at_the_end(
    endpoint: str, connected: Sessions, tmp_path: Path
) -> None:
    arrived = threading.Semaphore(0)
    told: queue.SimpleQueue[Sent] = queue.SimpleQueue()
    viewer = connected()
    viewer.subscribe(KEY, lambda _: arrived.release())
    viewer.subscribe(sent_key(KEY), lambda said: told.put(Sent.decode(said.payload)))
    viewer.confirm()
    with EnvelopePublisher(ZenohOptions(connect=(endpoint,)), tmp_path / "spool") as robot:
        robot.publish(envelope(5))
        while told.get(timeout=DEADLINE_S) != Sent(run_id="run-a", last=5):
            pass
        for k, run_id in ((7, "run-a"), (6, "run-a"), (1, "run-b")):
            robot.publish(envelope(k, run_id=run_id))
        for _ in range(4):
            assert arrived.acquire(timeout=DEADLINE_S)
    awaited = {Sent(run_id="run-a", last=7), Sent(run_id="run-b", last=1)}
    while awaited:
        awaited.discard(told.get(timeout=DEADLINE_S))


def test_kill_9_loses_nothing_that_was_acknowledged_and_resending_fills_the_rest(
    robot: EnvelopePublisher,
    connected: Sessions,
    recorder: Callable[[], Program],
    tmp_path: Path,
) -> None:
    """Three recorders are killed under load; each time the log must hold what was acked by then."""
    sent = [payload(envelope(k, note="x" * 1_000)) for k in range(KEYFRAMES)]
    keyframes = {payload_sha256(message): k for k, message in enumerate(sent)}
    acked: set[int] = set()
    progress = threading.Condition()

    def hear(message: Received) -> None:
        with progress:
            acked.update(keyframes[digest] for digest in Ack.decode(message.payload).sha256)
            progress.notify_all()

    watcher = connected()
    watcher.subscribe(ack_key("run-a"), hear)
    watcher.confirm()
    published = threading.Event()

    def publish() -> None:
        for message in sent:
            robot.publish(message)
        published.set()

    thread = threading.Thread(target=publish)
    thread.start()
    for wanted in (100, 500, 1_000):
        program = recorder()
        with progress:
            assert progress.wait_for(lambda n=wanted: len(acked) >= n, DEADLINE_S)
        assert program.end(signal.SIGKILL) == -signal.SIGKILL
        with progress:
            promised = set(acked)
        with LogWriter(tmp_path / "log"):
            pass  # what a restart does: recover the torn end
        assert promised <= keyframe_ids(tmp_path / "log")
    recorder()
    thread.join()
    assert published.is_set()
    assert robot.flush(DEADLINE_S)
    assert keyframe_ids(tmp_path / "log") == set(range(KEYFRAMES))
