"""Incomplete and malformed HTTP requests, unread answers: real sockets, a small application."""

import asyncio
import json
import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from http.client import HTTPConnection
from typing import Any

import pytest
import uvicorn
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from projections.surfaces.serve import connections
from projections.surfaces.serve.listening import accept_pending, bind, serving, tls_context
from tests.support.fixtures_zenoh import Certificate
from tests.support.http_attacks import DEADLINE_S, answer, ask, connect, request, status

LONG = 16 * 1024 * 1024
SECONDS = 0.5
START = Callable[..., int]


async def application(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers with the length of the body; at /long with more than a socket's buffers take; at
    /begin it begins to answer, and goes on as long as the client reads."""
    asked = Request(scope, receive)
    if scope["path"] == "/begin":
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"begun", "more_body": True})
        while (await receive())["type"] != "http.disconnect":
            pass
        return
    try:
        body = await asked.body()
    except ClientDisconnect:
        return
    long = scope["path"] == "/long"
    await Response(b"x" * LONG if long else b"%d" % len(body))(scope, receive, send)


@pytest.fixture
def notes() -> list[str]:
    return []


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, notes: list[str]) -> Iterator[START]:
    """Starts servers with limits that a test can reach; they end with the test."""
    with ExitStack() as servers:

        def start(most: int = 8, seconds: float = SECONDS, **options: Any) -> int:
            monkeypatch.setattr(connections, "REQUEST_S", seconds)
            monkeypatch.setattr(connections, "ANSWER_S", seconds)
            monkeypatch.setattr("projections.surfaces.serve.listening.REQUEST_S", seconds)
            monkeypatch.setattr("projections.surfaces.serve.listening.MAX_CONNECTIONS", most)
            listener = bind("127.0.0.1", 0)
            return servers.enter_context(
                serving(application, listener, note=notes.append, **options)
            )

        yield start


def refused(response: bytes) -> tuple[int, str]:
    """The status and kind of a refusal in the documented form."""
    head, _, body = response.partition(b"\r\n\r\n")
    error = json.loads(body)["error"]
    assert set(error) == {"kind", "message"}
    assert b"\r\nconnection: close" in head.lower()
    return status(response), error["kind"]


@pytest.mark.parametrize(
    "sent",
    [b"", b"P", b"POST / HTTP/1.1\r\nHost: x\r\n", request("POST", "/", b"12345")[:-1]],
    ids=["nothing", "a byte", "half a head", "a body without its end"],
)
def test_an_incomplete_request_times_out(start: START, notes: list[str], sent: bytes) -> None:
    assert refused(ask(start(), sent)) == (408, "bad_question")
    assert notes == ["http: closed a connection: no complete request within 0.5 s"]


def test_single_bytes_do_not_extend_the_time(start: START, notes: list[str]) -> None:
    with connect(start()) as dripping:
        dripping.sendall(request("POST", "/", b"x" * 10**6)[: -(10**6)])
        dripping.settimeout(0.02)
        sent = 0
        while not notes:
            dripping.send(b"x")
            sent += 1
            with suppress(TimeoutError):
                dripping.recv(65_536)
        assert sent < 10**6
    assert notes == ["http: closed a connection: no complete request within 0.5 s"]


def test_a_reused_connection_has_the_full_time_again(start: START) -> None:
    with connect(start(seconds=DEADLINE_S)) as one, one.makefile("rb") as answers:
        for _ in range(3):
            one.sendall(request("POST", "/", b"12345", {"Connection": "keep-alive"}))
            assert [line for line in iter(answers.readline, b"\r\n") if b"200 OK" in line]
            assert answers.read(1) == b"5"


def test_an_unread_answer_times_out(start: START, notes: list[str]) -> None:
    port = start()
    with connect(port) as deaf:
        deaf.sendall(request("GET", "/long"))
        while not notes:
            assert status(ask(port, request("GET", "/"))) == 200
    assert notes == ["http: closed a connection: no answer was read within 0.5 s"]


def test_unread_answers_are_limited_together(
    start: START, notes: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_UNREAD", LONG // 8)
    port = start(seconds=DEADLINE_S)
    with ExitStack() as held:
        for _ in range(4):
            deaf = held.enter_context(connect(port))
            deaf.sendall(request("GET", "/long"))
        while not notes:
            ask(port, request("GET", "/"))
    assert notes[0] == "http: closed a connection: its answer is long and was not read"


class TestFull:
    """More connections than may be open."""

    def test_the_peer_with_the_most_loses_the_one_that_waited_longest(self, start: START) -> None:
        port = start(most=6, seconds=DEADLINE_S)
        with ExitStack() as held:
            mine = held.enter_context(connect(port, "127.0.0.2"))
            mine.sendall(b"P")
            others = [held.enter_context(connect(port, "127.0.0.3")) for _ in range(20)]
            for other in others[:15]:
                assert answer(other) == b""
            mine.sendall(request("POST", "/", b"12345")[1:])
            assert answer(mine).endswith(b"\r\n\r\n5")
            others[-1].sendall(request("POST", "/", b"123"))
            assert answer(others[-1]).endswith(b"\r\n\r\n3")

    def test_the_peer_with_most_answers_under_way_loses_the_newest(self, start: START) -> None:
        port = start(most=4, seconds=DEADLINE_S)
        with ExitStack() as held:
            others = [held.enter_context(connect(port, "127.0.0.3")) for _ in range(4)]
            for other in others:
                other.sendall(request("GET", "/begin"))
                assert b"200" in other.recv(65_536)
            assert ask(port, request("POST", "/", b"1"), source="127.0.0.3") == b""
            mine = ask(port, request("POST", "/", b"12345"), source="127.0.0.2")
            assert mine.endswith(b"\r\n\r\n5")
            assert not answer(others[-1]).endswith(b"0\r\n\r\n"), "cut off in the middle"

    def test_incomplete_handshakes_count_too(self, start: START, certificate: Certificate) -> None:
        port = start(most=6, seconds=DEADLINE_S, tls=tls_context(certificate.cert, certificate.key))
        client = ssl.create_default_context(cafile=str(certificate.cert))
        with ExitStack() as held:
            silent = [held.enter_context(connect(port)) for _ in range(20)]
            for one in silent[:14]:
                assert answer(one) == b""
            with client.wrap_socket(connect(port), server_hostname="127.0.0.1") as honest:
                honest.sendall(request("POST", "/", b"12345"))
                assert answer(honest).endswith(b"5")

    def test_an_incomplete_handshake_times_out(
        self, start: START, certificate: Certificate
    ) -> None:
        port = start(tls=tls_context(certificate.cert, certificate.key))
        assert ask(port, b"") == b""
        assert ask(port, b"GET / HTTP/1.1\r\n\r\n") == b""


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        (b"\x16\x03\x01 nonsense\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n", 400),
        (b"GET / HTTP/1.1\r\nHost: a\r\nX: " + b"x" * 20_000, 431),
        (request("POST", "/", b"", {"Content-Length": "-1"}), 400),
        (request("POST", "/", b"", {"Content-Length": "1, 2"}), 400),
        (b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: chunked\r\n\r\n" + b"1\r\na\r\n", 411),
        (b"POST / HTTP/1.1\r\nHost: a\r\nTransfer-Encoding: gzip\r\n\r\n", 411),
        (b"GET / HTTP/1.1 x\r\n\r\n", 400),
    ],
    ids=lambda value: str(value)[:50],
)
def test_malformed_requests_are_refused_in_the_form_of_all_others(
    start: START, sent: bytes, expected: int
) -> None:
    code, kind = refused(ask(start(), sent))
    assert kind == "bad_question"
    assert code == expected


def test_an_upgrade_request_is_answered_without_upgrade(start: START) -> None:
    upgrade = {"Connection": "Upgrade, close", "Upgrade": "websocket"}
    assert status(ask(start(), request("GET", "/", headers=upgrade))) == 200


def test_pipelined_requests_are_answered_in_order(start: START) -> None:
    ahead = request("POST", "/", b"123", {"Connection": "keep-alive"}) * 50
    got = ask(start(seconds=DEADLINE_S), ahead + request("POST", "/", b"1"))
    assert got.count(b"HTTP/1.1 200 OK") == 51


def test_the_end_does_not_wait_for_an_incomplete_request(start: START) -> None:
    listener = bind("127.0.0.1", 0)
    with ExitStack() as held, serving(application, listener) as port:
        for sent in (b"", b"P", request("POST", "/", b"12345")[:-1]):
            held.enter_context(connect(port)).sendall(sent)
        assert status(ask(port, request("GET", "/"))) == 200


def test_the_end_while_a_client_connects_logs_no_error(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The server ends in the turn of its event loop that sees the connection in the backlog."""
    connected = threading.Event()
    with bind("127.0.0.1", 0) as listener, ExitStack() as clients:

        async def connect_and_end(server: uvicorn.Server) -> None:
            await asyncio.sleep(0.01)  # the server accepts from now on
            clients.enter_context(connect(listener.getsockname()[1]))
            connected.set()
            await asyncio.sleep(0)

        monkeypatch.setattr(uvicorn.Server, "main_loop", connect_and_end)
        with serving(application, listener):
            assert connected.wait(DEADLINE_S)
    assert not caplog.records


@pytest.mark.parametrize(
    ("address", "peer"),
    [
        ("192.0.2.7", "192.0.2.7"),
        ("2001:db8::1", "2001:db8::/64"),
        ("2001:db8::ffff:1", "2001:db8::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("::ffff:192.0.2.7", "192.0.2.7"),
    ],
)
def test_the_peer_of_an_address(address: str, peer: str) -> None:
    assert connections.peer_of(address) == peer


def test_pending_connections_are_accepted_a_few_at_a_time() -> None:
    with bind("127.0.0.1", 0) as listener, ExitStack() as clients:
        listener.setblocking(False)
        listener.listen(16)
        for _ in range(5):
            clients.enter_context(socket.create_connection(listener.getsockname(), DEADLINE_S))
        for most, accepted in ((3, 3), (10, 2), (10, 0)):
            taken = [clients.enter_context(one) for one in accept_pending(listener, most)]
            assert len(taken) == accepted


def test_answers_on_a_used_connection_are_sent_at_once() -> None:
    """With Nagle's algorithm each would wait 40 ms for the peer's delayed acknowledgement."""
    times = []
    with serving(application, bind("127.0.0.1", 0)) as port:
        connection = HTTPConnection("127.0.0.1", port, timeout=DEADLINE_S)
        with closing(connection):
            for _ in range(60):
                began = time.perf_counter()
                connection.request("GET", "/")
                assert connection.getresponse().read() == b"0"
                times.append(time.perf_counter() - began)
    assert min(times[-20:]) < 0.03
