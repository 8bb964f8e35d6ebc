"""Very many, slow, silent or malformed connections to the service, beside honest questions."""

import random
import socket
import threading
from contextlib import ExitStack, suppress
from urllib.parse import urlsplit

from scripts.programs.attack.arena import Arena
from scripts.programs.attack.honest_client import HonestClient, ask, question
from scripts.programs.attack.service import serve

MANY = 1_100
HELD_S = 4.0
DRIP_S = 0.5
ELSEWHERE = "127.0.0.2"
"""An address of this machine's own, as all of 127.0.0.0/8 are on Linux."""
_LENGTH = b"Content-Length: 900000\r\n\r\n"
_CHUNKED = b"Transfer-Encoding: chunked\r\n\r\n"
HALF = b"GET /health HTTP/1.1\r\nHost: localhost\r\nX-Slow: "
AHEAD = b"GET /health HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20
BEGINNINGS = (
    b"",
    HALF,
    b"POST /relocalize HTTP/1.1\r\nHost: localhost\r\n" + _LENGTH + b'{"crops":[',
    AHEAD,
    b"\x16\x03\x01\x02\x00\x01\x00" + bytes(100),
    b"GET /" + b"x" * 200_000,
    b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"X: y\r\n" * 20_000,
    b"POST /relocalize HTTP/1.1\r\nHost: localhost\r\n" + _CHUNKED + b"fffffff\r\n",
)


CASES = (("127.0.0.1", HALF), (ELSEWHERE, AHEAD))
"""Half requests use up no share, whole ones that of their address."""


def attack(arena: Arena) -> None:
    """Round 0: half-sent heads from the address of the honest one, and requests sent ahead from
    another; later a bit of everything from another."""
    service = serve(arena)
    netloc = urlsplit(service.url)
    address = (netloc.hostname or "", netloc.port or 0)
    with HonestClient(service.url, arena.tally):
        for source, begin in CASES if arena.round == 0 else [(ELSEWHERE, None)]:
            _hold_many(arena, address, source, begin)
    ask(f"{service.url}/relocalize", question())  # and afterwards it is as it was
    arena.finish(service.server, codes=(0,))


def _hold_many(arena: Arena, address: tuple[str, int], source: str, begin: bytes | None) -> None:
    """Open many connections, hold them for a while with a drop now and then, and let go."""
    with ExitStack() as open_ones:
        held = []
        for number in range(MANY):
            said = begin or arena.rng.choice(BEGINNINGS)
            connection = _open(address, source, said)
            if connection is None:
                arena.complain(f"connection {number} was not taken in time")
                break
            open_ones.enter_context(connection)
            held.append(connection)
        _drip(held, arena.rng)


def _open(address: tuple[str, int], source: str, begin: bytes) -> socket.socket | None:
    """A connection that has said ``begin``, or had it refused; None when it is not accepted."""
    try:
        connection = socket.create_connection(address, timeout=5.0, source_address=(source, 0))
    except ConnectionError:
        return socket.socket()  # refused at once, which is an answer
    except TimeoutError:
        return None
    connection.setblocking(False)
    with suppress(BlockingIOError, ConnectionError):
        connection.send(begin)
    return connection


def _drip(connections: list[socket.socket], rng: random.Random) -> None:
    pause = threading.Event()
    for _ in range(int(HELD_S / DRIP_S)):
        pause.wait(DRIP_S)
        for connection in rng.sample(connections, min(100, len(connections))):
            try:
                connection.send(b"a")
            except OSError:  # the service has let go of it, as it should
                continue
