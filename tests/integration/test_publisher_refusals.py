"""What a robot's publisher refuses, what recorders refuse of it, and wrong acknowledgements."""

import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from eventsrc.base.errors import InvalidEnvelope, MisuseError, SpoolFull, TransportError
from eventsrc.envelope.system_events import REJECTED_KEY
from eventsrc.log import LogReader
from eventsrc.record.robot.acks import Refusal, Refusals, ack_key, refusal_key
from eventsrc.record.robot.publisher import EnvelopePublisher, Sender
from eventsrc.record.transport.session import Session, ZenohOptions
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.fixtures_zenoh import DEADLINE_S, NEVER_S, Program
from tests.support.recorders import encoded_ack, keyframe_ids, robot_at, stored_payloads

Sessions = Callable[[], Session]
Start = Callable[..., Program]


@pytest.fixture
def robot(endpoint: str, tmp_path: Path) -> Iterator[EnvelopePublisher]:
    with robot_at(endpoint, tmp_path) as publisher:
        yield publisher


@pytest.mark.slow
def test_nonsense_on_the_ack_key_acknowledges_nothing(
    endpoint: str, connected: Sessions, tmp_path: Path
) -> None:
    """The pauses between resends double: five are 31 times the first."""
    arrived = threading.Semaphore(0)
    viewer = connected()
    viewer.subscribe(KEY, lambda _: arrived.release())
    viewer.confirm()
    mine, others = payload(envelope(1)), payload(envelope(1, note="another robot's"))
    older = b'{"run_id":"run-a","log_id":"log","stretches":[[0,9]]}'
    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool", resend_after_s=0.05) as robot:
        robot.publish(envelope(1))
        assert arrived.acquire(timeout=DEADLINE_S)
        for wrong in (b"{}", encoded_ack(others), encoded_ack(mine, key="tb/other"), older):
            viewer.send(ack_key("run-a"), wrong)
            assert arrived.acquire(timeout=DEADLINE_S), "it is sent again"
        assert arrived.acquire(timeout=DEADLINE_S)
        assert robot.unacknowledged == 1
        viewer.send(ack_key("run-a"), encoded_ack(others, mine))
        assert robot.flush(DEADLINE_S)


@pytest.mark.parametrize(
    "bad", [b"no json", {"run_id": "run-a"}, envelope(1, timestamp=float("nan")), {"run_id": {1}}]
)
def test_an_invalid_envelope_is_refused_on_publishing(
    robot: EnvelopePublisher, bad: object
) -> None:
    with pytest.raises(InvalidEnvelope, match="envelope not published: "):
        robot.publish(bad)  # type: ignore[arg-type]
    assert robot.unacknowledged == 0


def test_refused_envelopes_block_nothing(start: Start, endpoint: str, tmp_path: Path) -> None:
    """More envelopes are refused than may be under way, before and between good ones; none is
    sent again."""
    log = tmp_path / "log"
    recorder = start("record", str(log), "--connect", endpoint, "--max-payload", "1000")
    recorder.wait_for("recording")
    options = ZenohOptions(connect=(endpoint,))
    too_large = {*range(12), 20}
    with EnvelopePublisher(options, tmp_path / "spool", window=8, resend_after_s=NEVER_S) as robot:
        for k in range(25):
            robot.publish(envelope(k, note="x" * (1_000 if k in too_large else 10)))
        assert not robot.flush(DEADLINE_S), "not everything was acknowledged"
        assert robot.unacknowledged == 0
        assert robot.refused_count == len(too_large)
        refused = robot.refused()
        assert {one.keyframe_id for one in refused} == too_large
        assert {one.run_id for one in refused} == {"run-a"}
        assert all("over the limit of 1000" in one.reason for one in refused)
    assert recorder.end(signal.SIGINT) == 3
    assert keyframe_ids(log) == set(range(25)) - too_large
    with LogReader(log) as reader:
        assert len(list(reader.read(keys={REJECTED_KEY}))) == len(too_large), "each sent once"
        assert {one.log_id for one in refused} == {reader.log_id}


def test_refused_envelopes_are_kept_and_can_be_sent_again(
    start: Start, endpoint: str, tmp_path: Path
) -> None:
    options = ZenohOptions(connect=(endpoint,))
    log = str(tmp_path / "log")
    strict = start("record", log, "--connect", endpoint, "--max-payload", "10")
    strict.wait_for("recording")
    with EnvelopePublisher(options, tmp_path / "spool") as robot:
        robot.publish(envelope(1))
        assert not robot.flush(DEADLINE_S)
    assert strict.end(signal.SIGINT) == 3
    start("record", log, "--connect", endpoint).wait_for("recording")
    with EnvelopePublisher(options, tmp_path / "spool") as robot:
        assert not robot.flush(DEADLINE_S), "it is still known in the next process"
        assert robot.retry_refused() == 1
        assert robot.flush(DEADLINE_S)
        assert robot.refused() == []
    assert stored_payloads(tmp_path / "log") == [payload(envelope(1))]


def test_refusals_apply_only_to_the_same_bytes_under_the_same_key(
    robot: EnvelopePublisher, connected: Sessions
) -> None:
    """Nonsense, other bytes of the same size, and another robot's key change nothing."""
    arrived = threading.Semaphore(0)
    viewer = connected()
    viewer.subscribe(KEY, lambda _: arrived.release())
    viewer.confirm()
    mine, others = payload(envelope(1)), payload(envelope(2))
    assert len(mine) == len(others)
    robot.publish(mine)
    assert arrived.acquire(timeout=DEADLINE_S)

    def refuse(key: str, message: bytes) -> None:
        said = Refusals(log_id="log", refused=(Refusal.of(message, "too blue"),))
        viewer.send(refusal_key(key), said.encode())

    viewer.send(refusal_key(KEY), b"{}")
    refuse(KEY, others)
    refuse("tb/other", mine)
    assert arrived.acquire(timeout=DEADLINE_S), "it is sent again"
    assert arrived.acquire(timeout=DEADLINE_S)
    assert (robot.unacknowledged, robot.refused_count) == (1, 0)
    refuse(KEY, mine)
    assert not robot.flush(DEADLINE_S)
    assert [one.reason for one in robot.refused()] == ["too blue"]
    assert robot.discard_refused() == 1
    assert robot.flush(DEADLINE_S)


def test_a_reserved_key_is_misuse(tmp_path: Path) -> None:
    with pytest.raises(MisuseError, match="every recorder refuses envelopes under mapfold/"):
        EnvelopePublisher(ZenohOptions(), tmp_path / "spool", "mapfold/detections")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_publish_raises_when_the_sending_thread_has_died(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(_: Sender) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Sender, "_connect_and_send", die)
    with EnvelopePublisher(ZenohOptions(), tmp_path / "spool") as robot:
        robot._thread.join(DEADLINE_S)
        with pytest.raises(TransportError, match="the sending thread has died"):
            robot.publish(payload(envelope(1)))
        with pytest.raises(TransportError, match="the sending thread has died"):
            robot.flush(DEADLINE_S)


@pytest.mark.parametrize("key", ["", "tb//detections", "/tb", "tb/*"])
def test_an_invalid_key_is_misuse(tmp_path: Path, key: str) -> None:
    """Else it would be tried forever, and only the spool would grow."""
    with pytest.raises(MisuseError, match="nothing can be published under it"):
        EnvelopePublisher(ZenohOptions(), tmp_path / "spool", key)


def test_publish_raises_when_the_spool_is_full(endpoint: str, tmp_path: Path) -> None:
    message = payload(envelope(1))
    options = ZenohOptions(connect=(endpoint,))
    with EnvelopePublisher(options, tmp_path / "spool", max_spool_bytes=len(message)) as robot:
        robot.publish(message)
        with pytest.raises(SpoolFull):
            robot.publish(payload(envelope(2)))
        assert robot.unacknowledged == 1


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (ZenohOptions(connect=("localhost",)), "has no protocol"),
        (ZenohOptions(config_file=Path("no-file")), "no such Zenoh configuration"),
    ],
)
def test_invalid_options_are_misuse(tmp_path: Path, options: ZenohOptions, complaint: str) -> None:
    with pytest.raises(MisuseError, match=complaint):
        EnvelopePublisher(options, tmp_path / "spool")
