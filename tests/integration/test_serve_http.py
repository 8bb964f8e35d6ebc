"""Questions to `mapfold serve` over HTTP: the ASGI app behind a server on a free port."""

import gzip
import json
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from http.client import HTTPConnection

import pytest

from eventsrc.base.errors import TransportError
from projections.localize.relocalize import parse_question, question_schema
from projections.postgres.connection import Targets
from projections.postgres.queries.candidate_search import relocalize
from projections.surfaces.serve import Answerer, FairQueue, Pools
from tests.support.serve_questions import (
    DEADLINE_S,
    FORMS,
    fetch,
    http_at,
    question,
    tracked_question,
)


@pytest.fixture
def http(answerer: Answerer, queue: FairQueue) -> Iterator[str]:
    with http_at(answerer, queue) as port:
        yield f"http://127.0.0.1:{port}"


def test_the_answer_equals_the_librarys(http: str, walked_map: Targets) -> None:
    expected = relocalize(walked_map, parse_question(question()), top=1).document()
    assert fetch(f"{http}/relocalize?top=1", question()) == (200, expected)


@pytest.mark.parametrize("form", FORMS)
def test_views_classes_and_texts_are_answered(http: str, walked_map: Targets, form: str) -> None:
    expected = relocalize(walked_map, parse_question(FORMS[form])).document()
    assert fetch(f"{http}/relocalize", FORMS[form]) == (200, expected)


def test_a_session_is_tracked(http: str) -> None:
    for number in range(3):
        asked = tracked_question(number, (0.5, 0.0, 0.0), "robot-7")
        status, answer = fetch(f"{http}/relocalize", asked)
        assert (status, answer["track"]["questions"]) == (200, number + 1)
    _, answer = fetch(f"{http}/relocalize?session=robot-7", question())
    assert answer["track"]["questions"] == 4


def test_it_describes_itself(http: str) -> None:
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


def test_a_bad_question_is_400_and_says_why(http: str) -> None:
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


def test_a_misspelt_parameter_is_named_with_those_there_are(http: str) -> None:
    said = fetch(f"{http}/relocalize?tpo=3", question())[1]["error"]["message"]
    assert said == "no parameter called 'tpo'; there are top, method, session"


def test_a_compressed_body_is_refused_and_an_identical_one_answered(http: str) -> None:
    address = urllib.parse.urlsplit(http).netloc
    answers = []
    for encoding, body in [("gzip", gzip.compress(question())), ("identity", question())]:
        with closing(HTTPConnection(address, timeout=DEADLINE_S)) as connection:
            connection.request("POST", "/relocalize", body, {"Content-Encoding": encoding})
            answer = connection.getresponse()
            answers.append((answer.status, json.loads(answer.read())))
    assert [status for status, _ in answers] == [400, 200]
    said = answers[0][1]["error"]["message"]
    assert said == "Content-Encoding is 'gzip'; send the body uncompressed"


def test_an_unknown_path_is_refused_in_the_same_form(http: str) -> None:
    status, document = fetch(f"{http}/nothing")
    assert (status, document["error"]["kind"]) == (404, "bad_question")
    status, document = fetch(f"{http}/relocalize")
    assert (status, document["error"]["kind"]) == (405, "bad_question")


def test_its_description_names_what_a_path_and_an_option_may_be(http: str) -> None:
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
    assert refused["error"]["message"].startswith("the end of the path is 'rooms'; ")


@pytest.mark.parametrize(
    "path", ["/health", "/state/places?x=0&y=0", "/openapi.json", "/state/rooms?x=0&y=0"]
)
def test_head_is_answered_like_get_without_the_body(http: str, path: str) -> None:
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


def test_it_describes_no_refusal_that_it_never_gives(http: str) -> None:
    _, document = fetch(f"{http}/openapi.json")
    assert "422" not in document["paths"]["/relocalize"]["post"]["responses"]


def test_state_near_a_pose(http: str) -> None:
    status, found = fetch(f"{http}/state/places?x=0&y=0&radius=1000")
    assert (status, bool(found["places"])) == (200, True)


def test_too_much_is_429(pools: Pools, queue: FairQueue) -> None:
    with http_at(Answerer(pools, per_second=0.01), queue) as port:
        url = f"http://127.0.0.1:{port}/relocalize"
        assert fetch(url, question())[0] == 200
        assert fetch(url, question())[0] == 429


def test_it_ends_with_its_block_and_frees_the_port(answerer: Answerer, queue: FairQueue) -> None:
    with http_at(answerer, queue) as port:
        assert fetch(f"http://127.0.0.1:{port}/health")[0] == 200
        with pytest.raises(TransportError, match="in use"), http_at(answerer, queue, port):
            pytest.fail("two servers on one port")
    with http_at(answerer, queue, port) as again:
        assert again == port
