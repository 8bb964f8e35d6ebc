"""Zenoh sessions against real routers: messages arrive, failures are errors of one line."""

import queue
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from eventsrc.base.errors import MapfoldError, MisuseError, TransportError
from eventsrc.record.transport.declarations import CHANNEL_SIZE, _receive_batches
from eventsrc.record.transport.session import (
    Query,
    Received,
    Router,
    SequenceNumber,
    Session,
    ZenohOptions,
    open_session,
)
from tests.support.fixtures_zenoh import DEADLINE_S, LOOPBACK

Sessions = Callable[[], Session]


def _one_line(error: MapfoldError) -> str:
    text = str(error)
    assert "\n" not in text
    assert ".rs:" not in text
    return text


def test_bytes_arrive_as_sent_and_in_order(connected: Sessions) -> None:
    arrived: queue.SimpleQueue[Received] = queue.SimpleQueue()
    subscriber = connected()
    subscriber.subscribe("tb/**", arrived.put)
    publisher = connected().publisher("tb/detections")
    assert publisher.wait_for_subscriber(DEADLINE_S)
    sent = [bytes([n]) * size for n, size in enumerate((0, 1, 3_000, 9_000, 2_000_000))]
    for payload in sent:
        publisher.put(payload)
    got = [arrived.get(timeout=DEADLINE_S) for _ in sent]
    assert [m.payload for m in got] == sent
    assert {m.key for m in got} == {"tb/detections"}
    assert {m.number for m in got} == {None}


def test_batches_hold_all_messages_in_order(connected: Sessions) -> None:
    """While the first batch is handled, more messages come than Zenoh's channel holds."""
    batches: list[list[Received]] = []
    sent_some, came = threading.Event(), threading.Event()

    def handle(batch: list[Received]) -> None:
        batches.append(batch)
        if batch[-1].payload == payloads[-1]:
            came.set()
        sent_some.wait(DEADLINE_S)

    payloads = [b"%d" % number for number in range(3 * CHANNEL_SIZE)]
    subscription = connected().subscribe_batches("tb/*", handle)
    publisher = connected().publisher("tb/detections")
    assert publisher.wait_for_subscriber(DEADLINE_S)
    for payload in payloads:
        publisher.put(payload)
    sent_some.set()
    assert came.wait(DEADLINE_S)
    subscription.close()
    assert [message.payload for batch in batches for message in batch] == payloads
    assert {message.key for batch in batches for message in batch} == {"tb/detections"}
    assert max(map(len, batches)) > 1


def _batches(subscriber: Any, handle: Callable[[list[Received]], None]) -> None:
    """Receive in batches, in this thread, what the channel of an ended subscription holds."""
    channel = subscriber.handler
    subscriber.undeclare()
    _receive_batches(channel, handle)


@pytest.fixture
def filled(connected: Sessions) -> Any:
    """A subscriber with a channel in which there are the messages 0 … 299."""
    session = connected().raw
    subscriber = session.declare_subscriber("tf/n", zenoh.handlers.FifoChannel(1_000))
    for number in range(300):
        session.put("tf/n", b"%d" % number)
    return subscriber


def test_a_batch_that_is_taken_when_the_subscription_ends_is_handled(filled: Any) -> None:
    got: list[bytes] = []
    _batches(filled, lambda batch: got.extend(m.payload for m in batch))
    assert got == [b"%d" % number for number in range(300)]


def test_an_exception_is_reported_and_ends_one_batch_only(
    filled: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", reported.append)
    got: list[bytes] = []

    def handle(batch: list[Received]) -> None:
        if not reported:
            raise MemoryError
        got.extend(m.payload for m in batch)

    _batches(filled, handle)
    assert [args.exc_type for args in reported] == [MemoryError]
    assert got == [b"%d" % number for number in range(CHANNEL_SIZE, 300)]


def test_an_advanced_publishers_numbers_arrive_and_the_last_one_again(connected: Sessions) -> None:
    arrived: queue.SimpleQueue[Received] = queue.SimpleQueue()
    told: queue.SimpleQueue[SequenceNumber] = queue.SimpleQueue()
    subscriber = connected()
    subscriber.subscribe("tb/**", arrived.put)
    subscriber.subscribe_heartbeats("tb/**", told.put)
    subscriber.confirm()
    publisher = zenoh.ext.declare_advanced_publisher(
        connected().raw,
        "tb/detections",
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.1),
    )
    for _ in range(3):
        publisher.put(b"x")
    numbers = [arrived.get(timeout=DEADLINE_S).number for _ in range(3)]
    source = f"{publisher.id.zid}:{publisher.id.eid}"
    assert numbers == [SequenceNumber(source, value) for value in range(3)]
    while told.get(timeout=DEADLINE_S) != SequenceNumber(source, 2):
        pass


def test_messages_that_are_no_heartbeats_are_ignored(connected: Sessions) -> None:
    told: queue.SimpleQueue[SequenceNumber] = queue.SimpleQueue()
    subscriber, sender = connected(), connected()
    subscriber.subscribe_heartbeats("tb/x", told.put)
    subscriber.confirm()
    for key, payload in [("a/1/_", b"short"), ("a", b"1234"), ("a/1/_", b""), ("b/2", b"\1\0\0\0")]:
        sender.publisher(f"tb/x/@adv/pub/{key}").put(payload)
    assert told.get(timeout=DEADLINE_S) == SequenceNumber("b:2", 1)


def test_a_publisher_knows_whether_there_is_a_subscriber(connected: Sessions) -> None:
    publisher = connected().publisher("tb/detections")
    assert not publisher.has_subscriber
    assert not publisher.wait_for_subscriber(0.01)
    subscription = connected().subscribe("tb/*", lambda _: None)
    assert publisher.wait_for_subscriber(DEADLINE_S)
    subscription.close()


def test_a_closed_subscription_receives_nothing(connected: Sessions) -> None:
    arrived: queue.SimpleQueue[Received] = queue.SimpleQueue()
    subscriber, publisher = connected(), connected().publisher("tb/detections")
    closed = subscriber.subscribe("tb/*", arrived.put)
    subscriber.subscribe("tb/detections", lambda message: arrived.put(replace(message, key="open")))
    closed.close()
    assert publisher.wait_for_subscriber(DEADLINE_S)
    publisher.put(b"x")
    assert arrived.get(timeout=DEADLINE_S).key == "open"
    assert arrived.empty()


def test_confirm_returns_when_the_router_has_the_declarations(connected: Sessions) -> None:
    publisher_session = connected()
    subscriber = connected()
    arrived = threading.Event()
    subscriber.subscribe("tb/detections", lambda _: arrived.set())
    subscriber.confirm()
    publisher_session.publisher("tb/detections").put(b"straight away")
    assert arrived.wait(DEADLINE_S)


def test_a_query_gets_a_reply_or_an_error(connected: Sessions) -> None:
    def turn_around(query: Query) -> None:
        if query.payload:
            query.reply(query.key, query.payload[::-1])
        else:
            query.reply_error(b"nothing asked")

    server = connected()
    server.queryable("mapfold/relocalize", turn_around)
    server.confirm()
    asking = connected()
    assert asking.get("mapfold/relocalize", b"abc", timeout_s=DEADLINE_S) == [b"cba"]
    assert asking.get("mapfold/nobody", timeout_s=DEADLINE_S) == []
    assert asking.get("mapfold/relocalize", timeout_s=DEADLINE_S) == [], "a refusal is no answer"
    refused = asking.get_replies("mapfold/relocalize", timeout_s=DEADLINE_S)
    assert refused == [(False, b"nothing asked")]


def test_peers_connect_without_a_router() -> None:
    with open_session(LOOPBACK, mode="peer") as peer:
        assert not peer.is_connected


def test_a_free_port_is_named_and_freed() -> None:
    with Router(LOOPBACK) as router:
        (endpoint,) = router.endpoints
        assert not endpoint.endswith(":0")
    with Router(ZenohOptions(listen=(endpoint,))) as again:
        assert again.endpoints == (endpoint,)


def test_a_busy_port_is_one_clear_line(endpoint: str) -> None:
    with pytest.raises(TransportError) as caught:
        Router(ZenohOptions(listen=(endpoint,)))
    line = _one_line(caught.value)
    assert endpoint in line
    assert "in use" in line
    assert "--listen" in line


def test_an_absent_router_is_one_clear_line(endpoint: str) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    with pytest.raises(TransportError) as caught:
        open_session(ZenohOptions(connect=(away,)), mode="client")
    line = _one_line(caught.value)
    assert away in line
    assert "mapfold router" in line


def test_one_of_two_routers_is_enough(endpoint: str) -> None:
    with Router(LOOPBACK) as gone:
        (away,) = gone.endpoints
    with open_session(ZenohOptions(connect=(away, endpoint)), mode="client") as session:
        assert session.is_connected


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_a_malformed_endpoint_is_refused_before_anything_is_opened(mode: str) -> None:
    with pytest.raises(MisuseError, match="has no protocol"):
        open_session(ZenohOptions(connect=("127.0.0.1:7447",)), mode=mode)  # type: ignore[arg-type]


def test_a_malformed_key_expression_is_named(connected: Sessions) -> None:
    with pytest.raises(TransportError, match="tb//detections") as caught:
        connected().subscribe("tb//detections", lambda _: None)
    _one_line(caught.value)


def test_sending_on_a_closed_session_is_an_error(connected: Sessions) -> None:
    session = connected()
    publisher = session.publisher("tb/detections")
    session.close()
    session.close()
    with pytest.raises(TransportError, match="tb/detections"):
        publisher.put(b"x")


def test_the_configuration_file_has_the_endpoint(tmp_path: Path, endpoint: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text(f"{{ connect: {{ endpoints: ['{endpoint}'] }} }}")
    with open_session(ZenohOptions(config_file=file), mode="client") as session:
        assert session.is_connected


def test_the_command_line_takes_precedence_over_the_file(tmp_path: Path, endpoint: str) -> None:
    file = tmp_path / "zenoh.json5"
    file.write_text("{ mode: 'router', connect: { endpoints: ['tcp/127.0.0.1:1'] } }")
    options = ZenohOptions(connect=(endpoint,), config_file=file)
    with open_session(options, mode="client") as session:
        assert session.is_connected


@pytest.mark.parametrize("text", [None, "{ mode: 12 }", "not json5 {"])
def test_a_bad_configuration_file_is_named(tmp_path: Path, text: str | None) -> None:
    file = tmp_path / "zenoh.json5"
    if text is not None:
        file.write_text(text)
    with pytest.raises(MisuseError) as caught:
        open_session(ZenohOptions(config_file=file), mode="client")
    assert str(file) in _one_line(caught.value)


def test_a_recorder_that_listens_is_a_peer() -> None:
    assert ZenohOptions().mode == "client"
    assert ZenohOptions(listen=("tcp/127.0.0.1:0",)).mode == "peer"
