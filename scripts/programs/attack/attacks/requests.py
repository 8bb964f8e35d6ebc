"""HTTP requests that no honest client sends, whole and damaged, beside honest questions; then two
signals at once. The same to ports that speak TLS, with half handshakes, and to those of metrics."""

import random
import re
import signal
import socket
import ssl
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import partial
from urllib.parse import urlsplit

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.honest_client import HonestClient, question
from scripts.programs.attack.service import serve
from tests.support.fixtures_zenoh import make_certificate
from tests.support.logs import walk, write_log

SECONDS = 4.0
PATIENCE_S = 10.0
HANDSHAKES = 30
BUSY = (b"503",)
UNSPOKEN = (b"501", b"503", b"505")
"""Of a small server also methods and versions that it does not speak."""
_HOST = b"Host: localhost\r\n"
_END = b"Connection: close\r\n\r\n"
_PIECES = (b"\r\n", b"\0", b"\xff" * 9, b"%00", b"9" * 30, b'"', b"[", b"{")
HEADERS = (
    *(b"Host: evil", b"Host: [", b"Host: 127.0.0.1/evil", b"Host: " + b"a" * 10_000),
    *(b"Origin: http://[", b"Origin: null", b"Authorization: Bearer \xff\xfe", b"X: a\0b"),
    *(b"Upgrade: h2c", b"Expect: 200-maybe", b"Content-Encoding: \xff", b"Content-Type: \xff;;="),
    *(b"Content-Length: -4", b"Content-Length: " + b"9" * 5_000, b"Transfer-Encoding: gzip"),
    b"\r\n".join([b"a: b"] * 3_000),
)
TARGETS = (b"*", b"http://evil/health", b"/state/%ff%fe?x=%ff&y=%zz", b"/health?" + b"x=1&" * 3_000)
BODIES = (
    b'{"crops":[{"class":"\\ud800"}]}',
    b'{"session":"\\ud800","crops":[{"class":"cup"}]}',
    b'{"crops":[{"class":"\\"}) RETURN 1 //"}]}',
    b'{"session":"q","dx":1e308,"dy":1e308,"dyaw":1e308,"crops":[{"class":"cup"}]}',
    b'{"camera":{"hfov_deg":1e-300,"width_px":1e-300,"height_px":1e300},"crops":[{"class":"cup"}]}',
    "[]".encode("utf-16"),
)


def cases() -> Iterator[bytes]:
    """Requests, each with what comes with it on its connection."""
    body = question()
    post = b"POST /relocalize HTTP/1.1\r\n" + _HOST
    for header in HEADERS:
        yield b"GET /health HTTP/1.1\r\n" + _HOST + header + b"\r\n" + _END
        yield post + header + b"\r\nContent-Length: %d\r\n" % len(body) + _END + body
    for target in TARGETS:
        yield b"GET " + target + b" HTTP/1.1\r\n" + _HOST + _END
    for sent in BODIES:
        yield post + b"Content-Length: %d\r\n" % len(sent) + _END + sent
    ahead = post + b"Content-Length: %d\r\n\r\n" % len(body) + body
    yield ahead * 20 + b"GARBAGE\r\n\r\n"
    yield post + b"Content-Length: 4\r\n" + b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" + ahead
    yield b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"
    yield b"GET /health\r\n\r\n"


def attack(arena: Arena) -> None:
    """Round 0: the cases; later such that are damaged at random, for some seconds."""
    for case in (plain, secured, metrics):
        arena.attempt(case.__name__, partial(case, arena))


def plain(arena: Arena) -> None:
    """HTTP."""
    service = serve(arena)
    with HonestClient(service.url, arena.tally):
        _send_all(arena, service.url)
    for number in (signal.SIGTERM, signal.SIGHUP):
        service.server.process.send_signal(number)
    if (code := service.server.wait()) != 0:
        arena.complain(f"{service.server.command} ended with {code} after two signals")


def secured(arena: Arena) -> None:
    """HTTPS: HTTP instead of TLS, and handshakes that end anywhere and stay open."""
    made = make_certificate(arena.folder)
    service = serve(arena, None, "--tls-cert", made.cert, "--tls-key", made.key)
    context = ssl.create_default_context(cafile=made.cert)
    hello, held = _hello(context), []
    for _ in range(HANDSHAKES):
        held.append(socket.create_connection(_address(service.url), timeout=PATIENCE_S))
        held[-1].sendall(hello[: arena.rng.randrange(len(hello))])
    _send_all(arena, service.url)
    with urllib.request.urlopen(
        f"{service.url}/health", context=context, timeout=PATIENCE_S
    ) as got:
        if got.status != 200:
            arena.complain(f"/health over TLS: {got.status}")
    for connection in held:
        connection.close()
    arena.finish(service.server, codes=(0,))


def metrics(arena: Arena) -> None:
    """The numbers of a recorder and of a tail, beside readers that read nothing."""
    log, address = arena.folder / "recorded", ("--metrics", "127.0.0.1:0")
    recorder = arena.start("recorder", "record", log, "--connect", arena.router(), *address)
    recorder.wait_for("recording ")
    walked = write_log(arena.folder / "followed", walk(20))
    arena.run("reader", "replay", walked, "--db", arena.database(), codes=(0,))
    tail = arena.start("reader", "tail", walked, "--db", arena.database(), *address)
    for served in (recorder, tail):
        url = served.wait_for("metrics on http").split()[-1].removesuffix("/metrics")
        slow = [socket.create_connection(_address(url)) for _ in range(HANDSHAKES)]
        for connection in slow:
            connection.sendall(b"GET /metrics HTTP/1.1\r\n" + _HOST + b"\r\n")
        _send_all(arena, url, UNSPOKEN)
        with urllib.request.urlopen(f"{url}/metrics", timeout=PATIENCE_S) as got:
            if b"mapfold_" not in got.read():
                arena.complain(f"{served.command}: no metrics")
        for connection in slow:
            connection.close()
        arena.finish(served)


def _send_all(arena: Arena, url: str, allowed: Sequence[bytes] = BUSY) -> None:
    for sent in cases() if arena.round == 0 else _damaged(arena.rng):
        for status in re.findall(rb"HTTP/1\.[01] (5\d\d)", _answer(_address(url), sent)):
            if status not in allowed:
                arena.complain(f"{status.decode()} for {sent[:200]!r}")


def _address(url: str) -> tuple[str, int]:
    netloc = urlsplit(url)
    return netloc.hostname or "", netloc.port or 0


def _hello(context: ssl.SSLContext) -> bytes:
    """What a client of TLS sends first."""
    sent = ssl.MemoryBIO()
    with suppress(ssl.SSLWantReadError):
        context.wrap_bio(ssl.MemoryBIO(), sent, server_hostname="127.0.0.1").do_handshake()
    return sent.read()


def _damaged(rng: random.Random) -> Iterator[bytes]:
    known, end = [*cases()], time.monotonic() + SECONDS
    while time.monotonic() < end:
        sent = bytearray(rng.choice(known))
        for _ in range(rng.randint(1, 5)):
            at = rng.randrange(len(sent))
            sent[at : at + rng.choice([0, 1, 20])] = rng.choice(_PIECES)
        yield bytes(sent)


def _answer(address: tuple[str, int], sent: bytes) -> bytes:
    """What comes back until the service closes; b"" if it closes without an answer."""
    parts = []
    with socket.create_connection(address, timeout=PATIENCE_S) as connection:
        try:
            connection.sendall(sent)
            with suppress(OSError):  # closed already
                connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65_536):
                parts.append(part)
        except ConnectionError:  # closed while this end was still sending
            pass
    return b"".join(parts)
