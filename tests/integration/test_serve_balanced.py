"""Two servers behind a balancer answer as one does; only a session stays with its server."""

import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from http.client import HTTPConnection
from pathlib import Path

import pytest

from eventsrc.log import LogWriter
from eventsrc.record.append import append_payload
from projections.fold.settings import Settings
from projections.postgres import rebuild, tail
from projections.postgres.connection import Targets
from projections.surfaces.serve import Answerer, FairQueue, Pools
from projections.surfaces.serve.guard import Guard
from projections.surfaces.serve.http import create_app
from projections.surfaces.serve.listening import bind, serving
from tests.support.envelopes import payload
from tests.support.logs import walk, write_log
from tests.support.services import round_robin

pytestmark = pytest.mark.seconds
DEADLINE_S = 30.0
KEY = "tb/detections"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("balanced") / "log", walk(60, seed=3))


@pytest.fixture(scope="module")
def servers(log: Path, module_database: Targets) -> Iterator[tuple[int, int]]:
    """The ports of two servers with nothing in common but the database."""
    rebuild(log, module_database, Settings())
    with ExitStack() as stack:

        def start() -> int:
            pools = stack.enter_context(Pools(module_database, 2))
            queue = stack.enter_context(FairQueue(2, max_wait_s=DEADLINE_S))
            answerer = Answerer(pools, per_second=10_000.0)
            app = Guard(create_app(answerer, queue))
            return stack.enter_context(serving(app, bind("127.0.0.1", 0)))

        yield start(), start()


@pytest.fixture(scope="module")
def balancer(servers: tuple[int, int]) -> Iterator[int]:
    with round_robin(servers) as port:
        yield port


def asked(port: int, path: str, body: bytes | None = None) -> tuple[int, bytes]:
    connection = HTTPConnection("127.0.0.1", port, timeout=DEADLINE_S)
    try:
        connection.request("GET" if body is None else "POST", path, body)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def requests() -> list[tuple[str, bytes | None]]:
    seen = [d for d in walk(30, seed=9, run_id="run-b") if d["detections"]]
    questions: list[tuple[str, bytes | None]] = [
        (f"/relocalize?top={1 + k % 3}", json.dumps(document).encode())
        for k, document in enumerate(seen[:6])
    ]
    return [
        *questions,
        ("/relocalize?method=plain", questions[0][1]),
        ("/relocalize", b"nonsense"),
        ("/state/places?x=0&y=0&radius=1000", None),
        ("/state/objects?x=0&y=0&radius=1000", None),
        ("/state/secrets?x=0&y=0", None),
        ("/nowhere", None),
    ]


def test_both_answer_every_question_alike(servers: tuple[int, int], balancer: int) -> None:
    for path, body in requests():
        one, other = (asked(port, path, body) for port in servers)
        assert one == other
        assert [asked(balancer, path, body) for _ in range(2)] == [one, one]


@pytest.mark.slow
def test_many_clients_at_once_get_the_answers_of_one_server(
    servers: tuple[int, int], balancer: int
) -> None:
    wanted = {(path, body): asked(servers[0], path, body) for path, body in requests()}
    with ThreadPoolExecutor(8) as clients:
        answers = clients.map(lambda r: (r, asked(balancer, *r)), 4 * [*wanted])
    assert all(wanted[request] == answer for request, answer in answers)


def test_a_session_is_known_to_one_server_only(servers: tuple[int, int], balancer: int) -> None:
    _, body = requests()[0]

    def questions(port: int, name: str) -> list[int]:
        answers = [asked(port, f"/relocalize?session={name}", body) for _ in range(4)]
        return [json.loads(answer)["track"]["questions"] for _, answer in answers]

    assert questions(servers[0], "robot-1") == [1, 2, 3, 4]
    assert questions(balancer, "robot-2") == [1, 1, 2, 2]


def test_both_see_what_a_tail_adds(
    log: Path, module_database: Targets, servers: tuple[int, int], balancer: int
) -> None:
    path = "/state/places?x=500&y=500&radius=50"
    assert {asked(port, path) for port in servers} == {asked(balancer, path)}
    assert not json.loads(asked(balancer, path)[1])["places"]
    with LogWriter(log) as writer:
        for number, document in enumerate(walk(20, seed=3, run_id="run-far")):
            far = {**document, "keyframe_id": number}
            if "map_x" in far:
                far |= {"map_x": 500.0 + 0.1 * number, "map_y": 500.0}
            append_payload(writer, KEY, payload(far))
    tail(log, module_database, Settings(), once=True, stop=threading.Event())
    one, other = (asked(port, path) for port in servers)
    assert one == other == asked(balancer, path)
    assert json.loads(one[1])["places"]
