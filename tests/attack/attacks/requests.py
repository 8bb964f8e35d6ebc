"""HTTP requests that no honest client sends, whole and damaged, beside honest questions; then two
signals at once."""

import random
import re
import signal
import socket
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

from tests.attack.arena import Arena
from tests.attack.honest_client import HonestClient, question
from tests.attack.service import serve

SECONDS = 4.0
PATIENCE_S = 10.0
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
    service = serve(arena)
    netloc = urlsplit(service.url)
    address = (netloc.hostname or "", netloc.port or 0)
    with HonestClient(service.url, arena.tally):
        for sent in cases() if arena.round == 0 else _damaged(arena.rng):
            for status in re.findall(rb"HTTP/1\.1 (5\d\d)", _answer(address, sent)):
                if status != b"503":  # too many wait
                    arena.complain(f"{status.decode()} for {sent[:200]!r}")
    for number in (signal.SIGTERM, signal.SIGHUP):
        service.server.process.send_signal(number)
    if (code := service.server.wait()) != 0:
        arena.complain(f"{service.server.command} ended with {code} after two signals")


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
            connection.shutdown(socket.SHUT_WR)
            while part := connection.recv(65_536):
                parts.append(part)
        except ConnectionError:  # closed while this end was still sending
            pass
    return b"".join(parts)
