"""`mapfold serve` under attack: honest clients are answered, memory stays small."""

import json
import struct
import threading
from base64 import b64encode
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from eventsrc.record.transport.session import Session
from projections.fold.map_errors import QuestionError
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.postgres.connection import connect as connect_database
from projections.postgres.embedded import EmbeddedServer
from projections.surfaces.serve import Answerer, FairQueue, Pools, ZenohService
from projections.surfaces.serve.answering import encode
from tests.support.http_attacks import DEADLINE_S, Served, ask, connect, request, served, status
from tests.support.logs import walk, write_log

OPEN_FILES = 256
HALF_OPEN = 400
MEBIBYTE = 1024 * 1024


@pytest.fixture
def pg_server_folder(pg_server: EmbeddedServer) -> str:
    """What a message to others must not hold."""
    return str(pg_server.data)


@pytest.fixture
def service(walked_map: Targets) -> Iterator[Served]:
    args = ("--no-zenoh", "--http", "127.0.0.1:0", "--db", walked_map.graph_url)
    with served(*args, open_files=OPEN_FILES) as service:
        yield service


def question() -> bytes:
    documents = [d for d in walk(30, seed=9, run_id="run-b") if d["detections"]]
    return request("POST", "/relocalize", json.dumps(documents[0]).encode())


HALVES = [b"", b"P", b"POST /relocalize HTTP/1.1\r\nHost: 127.0.0.1\r\n", question()[:-1]]


@pytest.mark.slow
def test_half_open_connections_do_not_block_others(service: Served) -> None:
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


@pytest.mark.slow
def test_invalid_questions_delay_others_little(service: Served) -> None:
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
    try:
        for _ in range(10):
            assert status(ask(service.port, question(), source="127.0.0.2")) == 200
    finally:
        over.set()
        for thread in threads:
            thread.join()
    assert wrong == []
    assert service.peak_bytes < 600 * MEBIBYTE


def test_wrong_questions_are_400_and_name_no_path(service: Served, pg_server_folder: str) -> None:
    dimensions = [b64encode(struct.pack("<f", 1.0) * n).decode() for n in (3, 16_000, 16_001)]
    wrong = [json.dumps([{"embedding": text}]).encode() for text in dimensions]
    wrong += [json.dumps([{"embedding": [1.0] * n}]).encode() for n in (3, 16_000, 16_001, 16_385)]
    for body in (*JUNK, *wrong):
        got = ask(service.port, request("POST", "/relocalize", body))
        error = json.loads(got.partition(b"\r\n\r\n")[2])["error"]
        assert (status(got), error["kind"]) == (400, "bad_question")
        assert len(error["message"]) < 500
        assert pg_server_folder not in error["message"]
        assert "database" not in error["message"]


@pytest.mark.slow
def test_errors_of_the_database_name_no_path_either(
    one_database: Targets, tmp_path: Path, pg_server_folder: str
) -> None:
    rebuild(write_log(tmp_path / "log", walk(60, seed=3)), one_database, Settings())
    args = ("--no-zenoh", "--http", "127.0.0.1:0", "--db", one_database.graph_url)
    with served(*args) as service:
        with connect_database(one_database.graph_url, autocommit=True) as owner:
            owner.execute("LOAD 'age'")
            owner.execute("SELECT ag_catalog.drop_graph('semantic_map', true)")
        for path in ("/state/objects?x=0&y=0", "/state/places?x=0&y=0"):
            got = ask(service.port, request("GET", path))
            error = json.loads(got.partition(b"\r\n\r\n")[2])["error"]
            assert (status(got), error["kind"]) == (503, "database")
            assert pg_server_folder not in error["message"]
    # only now: what it says arrives by a pipe, and an answer may be there before
    assert pg_server_folder in service.text


class TestOverZenoh:
    """The same bounds for questions that come over Zenoh."""

    @pytest.fixture
    def asking(self, connected: Callable[[], Session], walked_map: Targets) -> Iterator[Session]:
        with (
            Pools(walked_map, 2) as pools,
            FairQueue(2, max_wait_s=DEADLINE_S) as queue,
            ZenohService(connected(), Answerer(pools, per_second=10_000.0), queue),
        ):
            yield connected()

    def test_every_wrong_question_gets_its_error(self, asking: Session) -> None:
        selectors = ["mapfold/relocalize"] * len(JUNK)
        selectors += [
            "mapfold/relocalize?" + "a=b;" * 3_000,
            "mapfold/relocalize?top=1e400",
            "mapfold/relocalize?top=" + "9" * 4000,
            "mapfold/state/" + "x" * 12_000 + "?x=0;y=0",
            "mapfold/state/**?x=0;y=0",
            "mapfold/**",
            "mapfold/state/places?x=1e308;y=1e308;radius=1e308",
        ]
        for number, selector in enumerate(selectors):
            payload = JUNK[number] if number < len(JUNK) else b"[]"
            for good, got in asking.get_replies(selector, payload, timeout_s=DEADLINE_S):
                error = json.loads(got)["error"]
                assert (good, error["kind"]) == (False, "bad_question"), selector[:50]
                assert len(error["message"]) < 500

    def test_the_size_of_a_question_is_checked_before_it_is_read(self, asking: Session) -> None:
        ((good, got),) = asking.get_replies(
            "mapfold/relocalize", bytes(10**7), timeout_s=DEADLINE_S
        )
        assert not good
        assert "has 10000000 bytes" in json.loads(got)["error"]["message"]


@pytest.mark.slow
def test_zenoh_drops_a_far_too_long_question(
    walked_map: Targets, endpoint: str, connected: Callable[[], Session]
) -> None:
    args = ("--connect", endpoint, "--http", "127.0.0.1:0", "--db", walked_map.graph_url)
    with served(*args) as service:
        asking, before = connected(), service.peak_bytes
        asking.get_replies("mapfold/relocalize", bytes(300 * MEBIBYTE), timeout_s=5.0)
        assert status(ask(service.port, question())) == 200
        ((good, _),) = asking.get_replies("mapfold/relocalize", b"nonsense", timeout_s=DEADLINE_S)
        assert not good
        assert service.peak_bytes - before < 150 * MEBIBYTE


NUMBERS = st.one_of(
    st.floats(width=32),
    st.integers(-(10**40), 10**40),
    st.sampled_from([0.0, 1e308, -1e308, 5e-324, 1e6, 640.0]),
)
BOXES = st.lists(NUMBERS, min_size=4, max_size=4)
CROPS = st.fixed_dictionaries(
    {"embedding": st.lists(st.floats(-1, 1, width=32), min_size=8, max_size=8)},
    optional={"bbox": BOXES, "class": st.text(max_size=5), "det_id": st.text(max_size=5)},
)
JSON: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | NUMBERS | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=5)
        | st.dictionaries(
            st.sampled_from(["crops", "detections", "embedding", "bbox", "top", "method", "class"]),
            inner,
        )
    ),
    max_leaves=20,
)
QUESTIONS = st.one_of(
    JSON,
    st.lists(st.one_of(CROPS, JSON), max_size=4),
    st.fixed_dictionaries(
        {"crops": st.lists(CROPS, min_size=1, max_size=4)},
        optional={"top": JSON, "method": st.sampled_from(["joint", "plain"]) | JSON},
    ),
).map(lambda document: json.dumps(document).encode())


@pytest.fixture
def answerer(walked_map: Targets) -> Iterator[Answerer]:
    with Pools(walked_map, 1) as pools:
        pools.on_graph(lambda _: None)  # connected: it uses `random`, which is Hypothesis's
        yield Answerer(pools, per_second=1e9)


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.one_of(QUESTIONS, st.binary(max_size=64)))
def test_any_question_is_answered_in_json_or_refused(answerer: Answerer, question: bytes) -> None:
    try:
        answer = answerer.relocalize(question, {})
    except QuestionError as error:
        said = str(error)
        assert said.isprintable()
        assert len(said) < 500
    else:
        assert json.loads(encode(answer))["places"] is not None


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(["places", "objects", "x" * 500, "**"]),
    st.dictionaries(
        st.sampled_from(["x", "y", "radius"]), st.one_of(NUMBERS.map(str), st.text(max_size=9))
    ),
)
def test_any_state_question_is_answered_or_refused(
    answerer: Answerer, what: str, options: dict[str, str]
) -> None:
    try:
        answer = answerer.state(what, options)
    except QuestionError as error:
        said = str(error)
        assert said.isprintable()
        assert len(said) < 500
    else:
        encode(answer)
