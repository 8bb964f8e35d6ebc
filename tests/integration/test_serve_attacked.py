"""`mapfold serve` while others attack it: honest clients are answered, memory stays small."""

import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from projections.postgres.connect import Targets
from projections.runner import rebuild
from projections.settings import Settings
from tests.http_attacks import Served, ask, connect, request, served, status
from tests.logs import walk, write_log

OPEN_FILES = 256
HALF_OPEN = 400
MEBIBYTE = 1024 * 1024


@pytest.fixture
def targets(tmp_path: Path, one_database: Targets) -> Targets:
    rebuild(write_log(tmp_path / "log", walk(60, seed=3)), one_database, Settings())
    return one_database


@pytest.fixture
def service(targets: Targets) -> Iterator[Served]:
    args = ("--no-zenoh", "--http", "127.0.0.1:0", "--db", targets.graph_url)
    with served(*args, open_files=OPEN_FILES) as service:
        yield service


def question() -> bytes:
    documents = [d for d in walk(30, seed=9, run_id="run-b") if d["detections"]]
    return request("POST", "/relocalize", json.dumps(documents[0]).encode())


HALVES = [b"", b"P", b"POST /relocalize HTTP/1.1\r\nHost: 127.0.0.1\r\n", question()[:-1]]


def test_half_open_connections_keep_nobody_out(service: Served) -> None:
    held = []
    try:
        for number in range(HALF_OPEN):
            held.append(connect(service.port))
            held[-1].sendall(HALVES[number % len(HALVES)])
        for _ in range(5):
            assert status(ask(service.port, question())) == 200
    finally:
        for connection in held:
            connection.close()


JUNK = [
    b'[{"embedding":[' + b"{}," * 300_000 + b"1]}]",
    b'[{"embedding":[' + b'"",' * 300_000 + b"1]}]",
    b"[" + b"[]," * 300_000 + b"1]",
    b"{" + b",".join(b'"%d":0' % number for number in range(90_000)) + b"}",
    b"[" + b"0.1," * 240_000 + b"1]",
    b'[{"embedding":[' + b"1," * 16_000 + b"1]}]",
    b'{"top":1e400,"crops":[{"embedding":[1]}]}',
    b"nonsense",
]


def test_junk_questions_delay_others_little(service: Served) -> None:
    over, wrong = threading.Event(), []

    def attack(number: int) -> None:
        while not over.is_set():
            got = ask(service.port, request("POST", "/relocalize", JUNK[number % len(JUNK)]))
            if not got or status(got) not in (400, 503):
                wrong.append(got)
            number += 1

    threads = [threading.Thread(target=attack, args=(number,)) for number in range(16)]
    for thread in threads:
        thread.start()
    times = []
    try:
        for _ in range(10):
            begun = time.monotonic()
            got = ask(service.port, question(), source="127.0.0.2")
            times.append(time.monotonic() - begun)
            assert status(got) == 200
    finally:
        over.set()
        for thread in threads:
            thread.join()
    print([round(t, 2) for t in times], service.peak_bytes / MEBIBYTE, service.text)
    assert wrong == []
    assert service.peak_bytes < 600 * MEBIBYTE
