"""Hostile questions to the service, over HTTP and Zenoh, beside honest ones."""

import http.client
import json
import random
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Any
from urllib.parse import urlsplit

from eventsrc.record.transport.session import ZenohOptions, open_session
from scripts.programs.attack.arena import Arena
from scripts.programs.attack.corruption import corrupt_json
from scripts.programs.attack.honest_client import HonestClient, question
from scripts.programs.attack.service import serve

MOST = 1_000_000
PATIENCE_S = 30.0
ASKERS = 4
LEAST_S = 4.0
_NO_HEADERS: Mapping[str, str] = MappingProxyType({})
SERVER_PATHS = ("/home", "/tmp", "/work", "/usr", ".py", "site-packages")


def cases() -> Iterator[bytes]:
    """Questions that once froze the service, or that it answered with a failure of its own."""
    yield b'{"crops":[{"embedding":[' + b'"x",' * 240_000 + b'"x"]}]}'
    yield b"[" + b"{}," * 300_000 + b"{}]"
    yield b'{"crops":[' + b",".join([b'{"bbox":["x"]}'] * 32) + b"]}"
    yield b'{"crops":[{"embedding":[' + b"1," * 16_000 + b"1]}]}"
    yield b'{"crops":[{"embedding":[' + b"1," * 16_384 + b"1]}]}"
    yield b'{"crops":[{"embedding":[' + b"1," * 400_000 + b"1]}]}"
    for value in (b"1e400", b"-1e400", b"NaN", b'"x"', b"[]", b"{}", b"null", b"1.5", b"9" * 5000):
        yield _question_with(b'"top":' + value)
        yield _question_with(b'"method":' + value)
        yield _question_with(b'"session":' + value)
        yield _question_with(b'"session":"robot","dy":0,"dyaw":0,"dx":' + value)
        yield _question_with(b'"views":' + value)
        yield (
            b'{"views":[{"crops":[{"class":"cup"}]},{"dx":0,"dy":0,"dyaw":%b,"crops":[]}]}' % value
        )
        yield b'{"crops":[{"class":"cup","text":%b}],"camera":%b}' % (value, value)
    yield b"[" * 900_000
    yield b'{"a":' * 150_000
    yield b"\xff" * 1000
    yield b"9" * 900_000
    yield b'{"crops":[{"embedding":"' + b"A" * 900_000 + b'"}]}'
    yield b'{"crops":[{"class":"' + b"\\u0000" * 100_000 + b'","embedding":[1]}]}'
    yield b'{"crops":[{"embedding":[1e308,1e308]}]}'
    yield b'{"crops":[' + b",".join(b'{"class":"%d"}' % n for n in range(32)) + b"]}"
    yield b'{"crops":[{"class":"' + b"x" * 900_000 + b'"}]}'
    yield b'{"views":[' + b",".join([b'{"dx":1e3,"dy":-1e3,"dyaw":9}'] * 100_000) + b"]}"
    yield b""


PATHS = (
    "/state/places?x=1e400&y=0",
    "/state/places?x=1e308&y=1e308&radius=1e308",
    "/state/objects?x=0&y=0&radius=-1",
    "/state/places?X=0&Y=0",
    "/state/places?cursor=%EF%BC%91",
    "/state/objects?cursor=999999999999999",
    "/state/objects?limit=1001",
    "/state/objects?limit=nan",
    "/state/%00?x=0&y=0",
    "/state/../../etc/passwd?x=0&y=0",
    "/relocalize?top=" + "9" * 5_000,
    "/relocalize?top=1e400",
    "/relocalize?method=%00",
    "/" + "x" * 8_000,
    "/docs/../secrets",
)
STRANGERS = ({"Host": "evil.example"}, {"Origin": "http://evil.example"})
"""What a page of another site says when a browser on this machine runs it."""


def attack(arena: Arena) -> None:
    """Round 0: the cases; later questions that were damaged at random."""
    endpoint = arena.router()
    service = serve(arena, endpoint)
    options = ZenohOptions(connect=(endpoint,))
    payloads = [*cases()] if arena.round == 0 else [*_corrupted(arena.rng)]
    with (
        HonestClient(service.url, arena.tally),
        open_session(options, mode="client") as session,
        ThreadPoolExecutor(ASKERS) as askers,
    ):
        asking = [
            askers.submit(_ask_again_and_again, arena, service.url, payloads) for _ in range(ASKERS)
        ]
        for payload in payloads:
            for good, answer in session.get_replies(
                "mapfold/relocalize", payload, timeout_s=PATIENCE_S
            ):
                _judge(arena, payload, 200 if good else 400, answer)
        for asked in asking:
            asked.result()
        for path in PATHS if arena.round == 0 else ():
            method = "POST" if path.startswith("/relocalize") else "GET"
            _judge(arena, path.encode(), *_ask(service.url, method, path, question()))
        for header in STRANGERS if arena.round == 0 else ():
            status, _ = _ask(service.url, "POST", "/relocalize", question(), header)
            if status < 400:
                arena.complain(f"{header}: answered with {status}")
    arena.finish(service.server, codes=(0,))


def _ask_again_and_again(arena: Arena, url: str, payloads: list[bytes]) -> None:
    """Each once, and on until it has taken a while."""
    end = time.monotonic() + LEAST_S
    while True:
        for payload in payloads:
            _judge(arena, payload, *_ask(url, "POST", "/relocalize", payload))
        if time.monotonic() > end:
            return


def _judge(arena: Arena, asked: bytes, status: int, answer: bytes) -> None:
    """Either an answer, or a refusal in the documented form that blames the question."""
    shown = f"{asked[:60]!r} ({len(asked)} bytes)"
    text = answer.decode(errors="replace")
    if status != 200 and _kind(answer) not in ("bad_question", "too_much", "refused"):
        arena.complain(f"{shown}: status {status}: {text[:200]}")
    if any(path in text for path in SERVER_PATHS if path not in asked.decode(errors="replace")):
        arena.complain(f"{shown}: a path of the server in the answer: {text[:200]}")


def _kind(answer: bytes) -> str | None:
    """The kind of a refusal in the documented form."""
    try:
        error: Any = json.loads(answer)["error"]
        return str(error["kind"]) if error["message"] else None
    except (ValueError, LookupError, TypeError):
        return None


def _ask(
    url: str, method: str, path: str, payload: bytes, headers: Mapping[str, str] = _NO_HEADERS
) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=PATIENCE_S)
    try:
        connection.request(method, path, payload if method == "POST" else None, headers)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def _question_with(field: bytes) -> bytes:
    document = json.loads(question())
    return json.dumps({"crops": document["detections"]}).encode()[:-1] + b"," + field + b"}"


def _corrupted(rng: random.Random) -> Iterator[bytes]:
    for _ in range(60):
        yield corrupt_json(question(), rng)[:MOST]
