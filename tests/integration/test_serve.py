"""`mapfold serve` on real parts: a router, a database, clients that ask at the same time."""

import json
import os
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest

from eventsrc.errors import TransportError
from eventsrc.transport.session import Session, ZenohOptions, open_session
from projections.database import rebuild
from projections.database.connection import Connection, Targets, connect
from projections.database.embedded import EmbeddedServer
from projections.errors import DatabaseUnavailable, ProjectionMissing
from projections.queries.relocalize import relocalize
from projections.relocalize import Track, parse_question, question_schema
from projections.serve import Answerer, FairQueue, Pools, ZenohService
from projections.serve.answering import TokenBucket, TooMuchError
from projections.serve.guard import Guard
from projections.serve.http import create_app
from projections.serve.listening import bind, serving
from projections.settings import Settings
from tests.commands import Commands
from tests.envelopes import detection
from tests.logs import WEIRD, walk, write_log
from tests.ready_program import ReadyProgram
from tests.servers import kill_postgres, server_to_kill
from tests.thorough import rounds

DEADLINE_S = 30.0
OTHER_SPACE = json.dumps([detection("x", [1.0, 2.0])]).encode()


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Targets:
    log = write_log(tmp_path_factory.mktemp("map") / "log", walk(60, seed=3))
    rebuild(log, module_database, Settings())
    return module_database


@pytest.fixture
def pools(targets: Targets) -> Iterator[Pools]:
    with Pools(targets, 4) as pools:
        yield pools


@pytest.fixture
def answerer(pools: Pools) -> Answerer:
    return Answerer(pools, per_second=10_000.0)


@pytest.fixture
def queue() -> Iterator[FairQueue]:
    with FairQueue(4, max_wait_s=DEADLINE_S) as queue:
        yield queue


@contextmanager
def http_at(answerer: Answerer, queue: FairQueue, port: int = 0) -> Iterator[int]:
    app = Guard(create_app(answerer, queue))
    with serving(app, bind("127.0.0.1", port)) as bound:
        yield bound


def question(number: int = 0) -> bytes:
    documents = [d for d in walk(30, seed=9, run_id="run-b") if d["detections"]]
    return json.dumps(documents[number % len(documents)]).encode()


def tracked_question(number: int, moved: tuple[float, float, float], name: str) -> bytes:
    crops = json.loads(question(number))["detections"]
    dx, dy, dyaw = moved
    asked = {"dx": dx, "dy": dy, "dyaw": dyaw, "crops": crops, "session": name}
    return json.dumps(asked).encode()


def _forms() -> dict[str, bytes]:
    first, second = (json.loads(question(n))["detections"] for n in (0, 1))
    moved = {"dx": 0.5, "dy": 0.0, "dyaw": 0.25, "crops": second}
    text = {"embedding": first[0]["embedding"], "text": True}
    forms: dict[str, Any] = {
        "views": {"views": [{"crops": first}, moved], "camera": CAMERA},
        "classes": {"crops": [{"class": WEIRD[0]}, {"class": WEIRD[1]}]},
        "both": [*first, {"class": WEIRD[2]}],
        "text": [text],
    }
    return {name: json.dumps(form).encode() for name, form in forms.items()}


CAMERA = {"hfov_deg": 90.0, "width_px": 640.0, "height_px": 480.0}
FORMS = _forms()


def ask(session: Session, selector: str, payload: bytes | None = None) -> tuple[bool, Any]:
    ((good, answer),) = session.get_replies(selector, payload, timeout_s=DEADLINE_S)
    return good, json.loads(answer)


class TestZenoh:
    """Over a router, from other sessions."""

    @pytest.fixture
    def service(
        self, connected: Callable[[], Session], answerer: Answerer, queue: FairQueue
    ) -> Iterator[ZenohService]:
        with ZenohService(connected(), answerer, queue) as service:
            yield service

    @pytest.mark.usefixtures("service")
    def test_the_answer_equals_the_librarys(
        self, connected: Callable[[], Session], targets: Targets
    ) -> None:
        good, answer = ask(connected(), "mapfold/relocalize", question())
        assert good
        assert answer == relocalize(targets, parse_question(question())).document()

    @pytest.mark.usefixtures("service")
    @pytest.mark.parametrize("form", FORMS)
    def test_views_classes_and_texts_are_answered(
        self, connected: Callable[[], Session], targets: Targets, form: str
    ) -> None:
        good, answer = ask(connected(), "mapfold/relocalize", FORMS[form])
        assert good
        assert answer == relocalize(targets, parse_question(FORMS[form])).document()
        assert answer["places"]

    @pytest.mark.usefixtures("service")
    def test_a_session_is_tracked(self, connected: Callable[[], Session], targets: Targets) -> None:
        track, session = Track("robot-7"), connected()
        for number in range(4):
            moved = (0.25 * number, 0.0, 0.125)
            asked = tracked_question(number, moved, "robot-7")
            answer = relocalize(targets, parse_question(asked))
            tracked = track.step(moved, answer.hypotheses, answer.confidence, answer.known)
            expected = answer.document() | {"track": tracked.document()}
            assert ask(session, "mapfold/relocalize", asked) == (True, expected)
        assert expected["track"]["questions"] == 4
        good, other = ask(session, "mapfold/relocalize?session=robot-8", question())
        assert good
        assert other["track"]["questions"] == 1

    @pytest.mark.usefixtures("service")
    def test_an_unknown_class_is_named_with_the_nearest(
        self, connected: Callable[[], Session]
    ) -> None:
        good, answer = ask(connected(), "mapfold/relocalize", b'[{"class": "baker rack"}]')
        assert not good
        assert "no object of class 'baker rack'; the nearest are baker's rack" in str(answer)

    @pytest.mark.usefixtures("service")
    def test_a_bad_question_gets_an_error_as_reply(self, connected: Callable[[], Session]) -> None:
        session = connected()
        one_of_nan = b'{"dx": 1, "dy": NaN, "dyaw": 0, "crops": [{"class": "a"}]}'
        for selector, payload in (
            ("mapfold/relocalize", b"nonsense"),
            ("mapfold/relocalize", None),
            ("mapfold/relocalize?top=0", question()),
            ("mapfold/relocalize?session=a;method=plain", question()),
            ("mapfold/relocalize", b'{"session": 7, "crops": [{"class": "a"}]}'),
            ("mapfold/relocalize?session=a", one_of_nan),
            ("mapfold/relocalize", b"[" * 2_000_000),
            ("mapfold/relocalize", OTHER_SPACE),
            ("mapfold/state/places?x=0", None),
            ("mapfold/state/places?X=0;Y=0", None),
            ("mapfold/state/places?radius=3", None),
            ("mapfold/state/places?cursor=a", None),
            ("mapfold/state/places?cursor=0;x=0;y=0", None),
            ("mapfold/state/objects?limit=0", None),
            ("mapfold/state/objects?limit=1001", None),
            ("mapfold/state/secrets?x=0;y=0", None),
        ):
            good, answer = ask(session, selector, payload)
            assert not good, selector
            assert answer["error"]["kind"] == "bad_question", selector
            assert answer["error"]["message"], selector

    @pytest.mark.usefixtures("service")
    def test_parameters_of_zenoh_are_passed_over(self, connected: Callable[[], Session]) -> None:
        session = connected()
        assert ask(session, "mapfold/state/places?_time=[..]") == ask(
            session, "mapfold/state/places"
        )

    @pytest.mark.usefixtures("service")
    def test_state_near_a_pose(self, connected: Callable[[], Session], pools: Pools) -> None:
        session = connected()
        good, found = ask(session, "mapfold/state/places?x=0;y=0;radius=1000")
        assert good
        distances = [place["distance_m"] for place in found["places"]]
        assert distances
        assert distances == sorted(distances)
        x, y = (found["places"][0][f"centroid_{axis}"] for axis in "xy")
        _, near = ask(session, f"mapfold/state/places?x={x};y={y};radius=0.01")
        assert [p["place_id"] for p in near["places"]] == [found["places"][0]["place_id"]]
        _, objects = ask(session, "mapfold/state/objects?x=0;y=0;radius=1000")
        assert {"object_id", "class_name", "distance_m"} <= set(objects["objects"][0])

    @pytest.mark.usefixtures("service")
    def test_eight_clients_at_once_get_their_own_answers(
        self, connected: Callable[[], Session], targets: Targets
    ) -> None:
        expected = [relocalize(targets, parse_question(question(n))).document() for n in range(8)]
        wrong: list[object] = []

        def client(session: Session, number: int) -> None:
            for _ in range(rounds(5, 2)):
                good, answer = ask(session, "mapfold/relocalize", question(number))
                if not good or answer != expected[number]:
                    wrong.append(answer)

        threads = [threading.Thread(target=client, args=(connected(), n)) for n in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []

    @pytest.mark.usefixtures("service")
    def test_a_broken_connection_costs_no_answer(
        self, connected: Callable[[], Session], targets: Targets
    ) -> None:
        session = connected()
        assert ask(session, "mapfold/relocalize", question())[0]
        with connect(targets.graph_url, autocommit=True) as killer:
            killer.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                " WHERE application_name = 'mapfold serve' AND datname = current_database()"
            )
        assert ask(session, "mapfold/relocalize", question())[0]

    def test_a_closed_service_has_answered_queued_questions(
        self, connected: Callable[[], Session], answerer: Answerer
    ) -> None:
        session, answers = connected(), []
        queue = FairQueue(1, max_wait_s=DEADLINE_S)
        service = ZenohService(connected(), answerer, queue)
        threads = [
            threading.Thread(
                target=lambda: answers.extend(
                    session.get_replies("mapfold/relocalize", question(), timeout_s=DEADLINE_S)
                )
            )
            for _ in range(4)
        ]
        for thread in threads:
            thread.start()
        service.close()
        service.close()
        queue.close()
        for thread in threads:
            thread.join()
        assert all(json.loads(answer) for _, answer in answers)
        assert session.get_replies("mapfold/relocalize", question(), timeout_s=1.0) == []


def test_too_many_questions_are_refused_not_queued_forever(pools: Pools) -> None:
    slow = Answerer(pools, per_second=0.01)
    slow.relocalize(question(), {})
    with pytest.raises(TooMuchError, match="a second"):
        slow.relocalize(question(), {})


def test_the_bucket_fills_with_time() -> None:
    now = [0.0]
    bucket = TokenBucket(2.0, now=lambda: now[0])
    for _ in range(4):
        bucket.take_token()
    with pytest.raises(TooMuchError):
        bucket.take_token()
    now[0] = 0.5
    bucket.take_token()
    with pytest.raises(TooMuchError):
        bucket.take_token()


def fetch(url: str, data: bytes | None = None) -> tuple[int, Any]:
    """Status and JSON body of one request; POST when there is data."""
    try:
        with urllib.request.urlopen(url, data, timeout=DEADLINE_S) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        with error:
            return error.code, json.loads(error.read())


class TestHttp:
    """The ASGI app behind a real server on a free port."""

    @pytest.fixture
    def http(self, answerer: Answerer, queue: FairQueue) -> Iterator[str]:
        with http_at(answerer, queue) as port:
            yield f"http://127.0.0.1:{port}"

    def test_the_answer_equals_the_librarys(self, http: str, targets: Targets) -> None:
        expected = relocalize(targets, parse_question(question()), top=1).document()
        assert fetch(f"{http}/relocalize?top=1", question()) == (200, expected)

    @pytest.mark.parametrize("form", FORMS)
    def test_views_classes_and_texts_are_answered(
        self, http: str, targets: Targets, form: str
    ) -> None:
        expected = relocalize(targets, parse_question(FORMS[form])).document()
        assert fetch(f"{http}/relocalize", FORMS[form]) == (200, expected)

    def test_a_session_is_tracked(self, http: str) -> None:
        for number in range(3):
            asked = tracked_question(number, (0.5, 0.0, 0.0), "robot-7")
            status, answer = fetch(f"{http}/relocalize", asked)
            assert (status, answer["track"]["questions"]) == (200, number + 1)
        _, answer = fetch(f"{http}/relocalize?session=robot-7", question())
        assert answer["track"]["questions"] == 4

    def test_it_describes_itself(self, http: str) -> None:
        _, document = fetch(f"{http}/openapi.json")
        asked = document["paths"]["/relocalize"]["post"]["requestBody"]["content"]
        forms = [form.get("properties", {}) for form in question_schema()["anyOf"]]
        described = asked["application/json"]["schema"]["anyOf"]
        options = {"top", "method", "session"}
        assert [set(form.get("properties", {})) for form in described] == [
            set(form) | options if form else set() for form in forms
        ]
        assert {"/relocalize", "/state/{what}", "/health"} <= set(document["paths"])
        assert fetch(f"{http}/health") == (200, {"status": "ok"})

    def test_a_bad_question_is_400_and_says_why(self, http: str) -> None:
        asked: list[tuple[str, bytes | None]] = [
            ("/relocalize", b"nonsense"),
            ("/relocalize", b"x" * 2_000_000),
            ("/relocalize?method=magic", question()),
            ("/state/secrets?x=0&y=0", None),
            ("/state/places?x=nan&y=0", None),
            ("/relocalize?top=abc", question()),
            ("/relocalize?top=0", question()),
            ("/state/places?x=0&y=0&raduis=5", None),
            ("/state/places?x=0", None),
            ("/state/places?y=0", None),
            ("/state/places?X=0&Y=0", None),
            ("/state/places?radius=3", None),
            ("/state/places?x=0&y=0&radius=-1", None),
            ("/state/places?x=0&y=0&cursor=1", None),
            ("/state/places?cursor=-1", None),
            ("/state/places?cursor=999999999999999", None),
            ("/state/places?limit=0", None),
            ("/state/places?limit=1001", None),
            ("/state/places?limit=1.5", None),
            ("/state/places?x=here&y=0", None),
        ]
        for path, data in asked:
            status, document = fetch(f"{http}{path}", data)
            assert (status, document["error"]["kind"]) == (400, "bad_question"), path

    def test_a_misspelt_parameter_is_named_with_those_there_are(self, http: str) -> None:
        said = fetch(f"{http}/relocalize?tpo=3", question())[1]["error"]["message"]
        assert said == "no parameter called 'tpo'; there are top, method, session"

    def test_an_unknown_path_is_refused_in_the_same_form(self, http: str) -> None:
        status, document = fetch(f"{http}/nothing")
        assert (status, document["error"]["kind"]) == (404, "bad_question")
        status, document = fetch(f"{http}/relocalize")
        assert (status, document["error"]["kind"]) == (405, "bad_question")

    def test_its_description_names_what_a_path_and_an_option_may_be(self, http: str) -> None:
        _, document = fetch(f"{http}/openapi.json")
        (what, *_) = (
            parameter
            for parameter in document["paths"]["/state/{what}"]["get"]["parameters"]
            if parameter["name"] == "what"
        )
        assert what["schema"]["enum"] == ["places", "objects"]
        for name in what["schema"]["enum"]:
            assert list(fetch(f"{http}/state/{name}?x=0&y=0")[1]) == [name]
        status, refused = fetch(f"{http}/state/rooms?x=0&y=0")
        assert (status, refused["error"]["kind"]) == (400, "bad_question")

    @pytest.mark.parametrize(
        "path", ["/health", "/state/places?x=0&y=0", "/openapi.json", "/state/rooms?x=0&y=0"]
    )
    def test_head_is_answered_like_get_without_the_body(self, http: str, path: str) -> None:
        address = urllib.parse.urlsplit(http).netloc
        said = []
        for method in ("GET", "HEAD"):
            connection = HTTPConnection(address, timeout=DEADLINE_S)
            with closing(connection):
                connection.request(method, path)
                answer = connection.getresponse()
                headers = {k: v for k, v in answer.getheaders() if k.lower() != "date"}
                said.append((answer.status, headers, len(answer.read())))
        get, head = said
        assert head[:2] == get[:2]
        assert (head[2], get[2] > 0) == (0, True)

    def test_it_describes_no_refusal_that_it_never_gives(self, http: str) -> None:
        _, document = fetch(f"{http}/openapi.json")
        assert "422" not in document["paths"]["/relocalize"]["post"]["responses"]

    def test_state_near_a_pose(self, http: str) -> None:
        status, found = fetch(f"{http}/state/places?x=0&y=0&radius=1000")
        assert (status, bool(found["places"])) == (200, True)

    def test_too_much_is_429(self, pools: Pools, queue: FairQueue) -> None:
        with http_at(Answerer(pools, per_second=0.01), queue) as port:
            url = f"http://127.0.0.1:{port}/relocalize"
            assert fetch(url, question())[0] == 200
            assert fetch(url, question())[0] == 429

    def test_it_ends_with_its_block_and_frees_the_port(
        self, answerer: Answerer, queue: FairQueue
    ) -> None:
        with http_at(answerer, queue) as port:
            assert fetch(f"http://127.0.0.1:{port}/health")[0] == 200
            with pytest.raises(TransportError, match="in use"), http_at(answerer, queue, port):
                pytest.fail("two servers on one port")
        with http_at(answerer, queue, port) as again:
            assert again == port


def test_the_command_serves_until_sigterm(endpoint: str, targets: Targets, tmp_path: Path) -> None:
    read, write = os.pipe()
    mapfold = Commands.in_folder(tmp_path)
    started = mapfold.start("serve", "--connect", endpoint, "--db", targets.graph_url, stderr=write)
    os.close(write)
    program = ReadyProgram(started, read, DEADLINE_S, DEADLINE_S)
    try:
        with open_session(ZenohOptions(connect=(endpoint,)), mode="client") as session:
            assert ask(session, "mapfold/relocalize", question())[0]
    finally:
        code = program.end()
    assert code == 0
    assert "service ended" in program.text


class TestKilledServer:
    """PostgreSQL dies under the service."""

    @pytest.fixture
    def server(self, tmp_path: Path) -> Iterator[EmbeddedServer]:
        with server_to_kill() as server:
            targets = Targets(server.url, server.url)
            rebuild(write_log(tmp_path / "log", walk(60, seed=3)), targets, Settings())
            yield server

    @pytest.mark.slow
    def test_the_embedded_server_is_restarted(self, server: EmbeddedServer) -> None:
        told: list[str] = []
        with Pools(Targets(server.url, server.url, server), 4, told.append) as pools:
            answerer = Answerer(pools, per_second=10_000.0)
            before = answerer.relocalize(question(), {})
            for _ in range(2):
                kill_postgres(server)
                assert answerer.relocalize(question(), {}) == before
            kill_postgres(server)
            assert answerer.health() == {"status": "ok"}
            assert answerer.relocalize(question(), {}) == before
        assert [line.endswith("trying again") for line in told[:4]] == [True, False, True, False]

    def test_questions_wait_for_another_server_at_first_and_fail_at_once_later(
        self, server: EmbeddedServer, queue: FairQueue, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr("projections.serve.pools.OUTAGE_TIMEOUT_S", 0.5)
        told: list[str] = []
        with Pools(Targets(server.url, server.url), 4, told.append) as pools:
            answerer = Answerer(pools, per_second=10_000.0)
            answerer.relocalize(question(), {})
            kill_postgres(server)
            with http_at(answerer, queue) as port:
                for path, data in (("relocalize", question()), ("health", None)):
                    status, document = fetch(f"http://127.0.0.1:{port}/{path}", data)
                    assert (status, document["error"]["kind"]) == (503, "database")
            monkeypatch.setattr("projections.serve.pools.OUTAGE_TIMEOUT_S", 2 * DEADLINE_S)
            assert not answerer.database_up
            begun = time.monotonic()
            with pytest.raises(DatabaseUnavailable, match="start the server"):
                answerer.relocalize(question(), {})
            assert time.monotonic() - begun < DEADLINE_S
            assert len(told) == 1
            server.start()
            assert answerer.relocalize(question(), {})["places"]
            assert answerer.database_up
        assert told[1:] == ["the database answers again"]


def test_a_full_pool_is_not_reported_as_an_outage(
    targets: Targets, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FIRST_WAIT_S", "LAST_WAIT_S"):
        monkeypatch.setattr(f"projections.serve.pools.{name}", 0.5)
    told: list[str] = []
    with Pools(targets, 1, told.append) as pools:

        def ask_too(_: Connection) -> None:
            with pytest.raises(DatabaseUnavailable, match="none of the 1 connections came free"):
                pools.on_graph(lambda _: None)

        pools.on_graph(ask_too)
    assert told == []


def test_it_does_not_start_without_a_map(one_database: Targets) -> None:
    with pytest.raises(ProjectionMissing, match="run `mapfold replay"):
        Pools(one_database, 1)


@pytest.mark.slow
def test_a_cut_connection_is_reported_in_one_line_of_ours(targets: Targets) -> None:
    program = subprocess.Popen(
        [
            *(sys.executable, "-m", "projections.cli", "serve", "--no-zenoh"),
            *("--http", "127.0.0.1:0", "--db", targets.graph_url),
        ],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert program.stderr is not None
        url = program.stderr.readline().split()[1].rstrip(",")
        assert fetch(f"{url}/relocalize", question())[0] == 200
        with connect(targets.graph_url, autocommit=True) as killer:
            killer.execute(
                "SELECT pg_terminate_backend(pid, 10000) FROM pg_stat_activity"
                " WHERE application_name = 'mapfold serve' AND datname = current_database()"
            )
        assert fetch(f"{url}/relocalize", question())[0] == 200
    finally:
        program.terminate()
        program.wait(DEADLINE_S)
    with program.stderr:
        lines = program.stderr.read().splitlines()  # not communicate(): readline() has read ahead
    assert lines[0] == "Ctrl-C ends it"
    assert lines[1].startswith("mapfold: database ")
    assert lines[2:] == ["mapfold: the database answers again", "service ended"]
