"""What `mapfold serve` sends over HTTP is what /openapi.json describes."""

import json
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from pydantic import TypeAdapter

from projections.database import rebuild
from projections.database.connection import Targets
from projections.errors import DatabaseError
from projections.serve import Answerer, FairQueue, Pools, models
from projections.serve.answering import BusyError, TooMuchError
from projections.serve.guard import Guard, SafeHeaders
from projections.serve.http import create_app
from projections.serve.listening import bind, serving
from projections.serve.metrics import CountedResponses, ServiceMetrics
from tests import described_maps
from tests.described_maps import build, documents
from tests.http_attacks import ask, request, status
from tests.logs import write_log

TOKEN = "0123456789abcdef-not-a-secret"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
FRIEND = "https://map.example"
PATHS = ("/relocalize", "/state/places", "/state/objects", "/health", "/metrics")


class Service:
    """One port with a token and one without, of the same answerer."""

    def __init__(self, answerer: Answerer, port: int, secured: int) -> None:
        self.answerer, self.port, self.secured = answerer, port, secured

    def get(
        self, path: str, body: bytes | None = None, *, secured: bool = False, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and body of one answer."""
        method = headers.pop("method", "GET" if body is None else "POST")
        port = self.secured if secured else self.port
        got = ask(port, request(method, path, body or b"", headers))
        head, _, content = got.partition(b"\r\n\r\n")
        fields = (line.split(": ", 1) for line in head.decode().split("\r\n")[1:])
        return status(got), {name.lower(): value for name, value in fields}, content

    def document(self, path: str, body: Any = None, **headers: str) -> Any:
        """A good answer's JSON."""
        sent = None if body is None else json.dumps(body).encode()
        code, _, content = self.get(path, sent, **headers)
        assert code == 200, content
        return json.loads(content)


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> Targets:
    build(tmp_path_factory.mktemp("described"), module_database)
    return module_database


@pytest.fixture(scope="module")
def service(targets: Targets) -> Iterator[Service]:
    with Pools(targets, 2) as pools, FairQueue(2, max_wait_s=30.0) as queue:
        answerer = Answerer(pools, per_second=10_000.0)
        metrics = ServiceMetrics(answerer, queue)
        apps = [
            CountedResponses(
                SafeHeaders(
                    Guard(
                        create_app(answerer, queue, metrics, secured=token is not None),
                        token,
                        origins=(FRIEND,),
                    )
                ),
                metrics,
            )
            for token in (None, TOKEN)
        ]
        with (
            serving(apps[0], bind("127.0.0.1", 0)) as port,
            serving(apps[1], bind("127.0.0.1", 0)) as secured,
        ):
            yield Service(answerer, port, secured)


@pytest.fixture(scope="module")
def described(service: Service) -> Any:
    return service.document("/openapi.json")


CROPS = [crop for document in documents(4) for crop in document["detections"]]
CLASS = {"crops": [{"class": "toilet"}]}
ASKED = (
    ("/relocalize", {"crops": CROPS}, models.Answer),
    ("/relocalize?method=plain", {"crops": CROPS}, models.Answer),
    ("/relocalize?session=a", {"crops": CROPS}, models.Answer),
    ("/relocalize?top=1", CLASS, models.Answer),
    ("/relocalize", [{"embedding": [1.0] * 512}], models.Answer),
    ("/state/places", None, models.Places),
    ("/state/objects?limit=3", None, models.Objects),
    ("/state/objects", None, models.Objects),
    ("/state/places?x=5&y=5&radius=100", None, models.Places),
    ("/state/objects?x=5&y=5&radius=100&limit=5", None, models.Objects),
    ("/state/objects?x=5000&y=5", None, models.Objects),
    ("/health", None, models.Health),
)


def test_every_answer_has_the_shape_described_and_every_described_key_is_sent(
    service: Service,
) -> None:
    sent: dict[str, set[str]] = defaultdict(set)
    for path, body, model in ASKED:
        data = None if body is None else json.dumps(body).encode()
        code, headers, content = service.get(path, data)
        assert (code, headers["content-type"]) == (200, "application/json"), (path, content)
        TypeAdapter(model).validate_json(content, strict=True, extra="forbid")
        _keys(json.loads(content), model.__name__, sent)
    for name, keys in sent.items():
        wanted = set(get_type_hints(getattr(models, name)))
        assert keys == wanted, (name, wanted ^ keys)
    assert set(sent) >= {"Answer", "RankedPlace", "Evidence", "Pose", "Track", "Place", "MapObject"}


PARTS = {
    ("Answer", "places"): "RankedPlace",
    ("Answer", "pose"): "Pose",
    ("Answer", "track"): "Track",
    ("RankedPlace", "evidence"): "Evidence",
    ("Places", "places"): "Place",
    ("Objects", "objects"): "MapObject",
}


def _keys(document: Any, name: str, sent: dict[str, set[str]]) -> None:
    sent[name] |= set(document)
    for key, value in document.items():
        part = PARTS.get((name, key))
        for item in value if isinstance(value, list) else [value]:
            if part and item is not None:
                _keys(item, part, sent)


def test_the_description_is_made_of_these_models(described: Any) -> None:
    shapes = described["components"]["schemas"]
    for model in (models.Answer, models.Places, models.Objects, models.Health, models.Refusal):
        schema = TypeAdapter(model).json_schema(ref_template="#/components/schemas/{model}")
        parts = schema.pop("$defs", {})
        assert shapes[model.__name__] == schema
        for name, part in parts.items():
            assert shapes[name] == part
    answers = {
        path: operation["responses"]["200"]["content"]
        for path, operations in described["paths"].items()
        for operation in operations.values()
    }
    refs = re.findall(r"schemas/(\w+)", json.dumps(answers))
    assert sorted(refs) == ["Answer", "Health", "Objects", "Places"]


def test_the_examples_work(service: Service, described: Any) -> None:
    question = described["paths"]["/relocalize"]["post"]
    examples = question["requestBody"]["content"]["application/json"]["examples"]
    assert len(examples) == 4
    for each in examples.values():
        answer = service.document("/relocalize", each["value"])
        assert answer["places"]
    for path, model in (
        ("/relocalize", models.Answer),
        ("/state/{what}", models.Places),
        ("/health", models.Health),
    ):
        (operation,) = described["paths"][path].values()
        shown = operation["responses"]["200"]["content"]["application/json"]["example"]
        TypeAdapter(model).validate_python(shown, strict=True, extra="forbid")


REFUSED = [
    (400, "/relocalize", b"nonsense", {}),
    (400, "/relocalize", b'{"crops": [{"class": "no such thing"}]}', {}),
    (400, "/state/rooms", None, {}),
    (400, "/state/places?x=1", None, {}),
    (401, "/health", None, {"secured": True}),
    (401, "/metrics", None, {"secured": True}),
    (403, "/health", None, {"Origin": "https://evil.example"}),
    (404, "/state/places/all", None, {}),
    (405, "/relocalize", None, {}),
    (405, "/metrics", b"", {}),
    (405, "/health", None, {"method": "OPTIONS"}),
    (411, "/relocalize", b"", {"Transfer-Encoding": "chunked", "method": "POST"}),
    (421, "/health", None, {"Host": "evil.example"}),
    (431, "/health", None, {"Junk": "x" * 400_000}),
]


@pytest.mark.parametrize(("code", "path", "body", "headers"), REFUSED)
def test_every_refusal_has_the_one_shape(
    service: Service, described: Any, code: int, path: str, body: bytes | None, headers: Any
) -> None:
    said, fields, content = service.get(path, body, **headers)
    assert (said, fields["content-type"]) == (code, "application/json"), content
    _check_refusal(described, path, code, fields, content)


def _check_refusal(
    described: Any, path: str, code: int, fields: dict[str, str], content: bytes
) -> None:
    TypeAdapter(models.Refusal).validate_json(content, strict=True, extra="forbid")
    assert fields["x-content-type-options"] == "nosniff"
    template = "/state/{what}" if path.startswith("/state") else path.partition("?")[0]
    for operation in described["paths"][template].values():
        response = operation["responses"][str(code)]
        assert response["content"]["application/json"]["schema"] == {
            "$ref": "#/components/schemas/Refusal"
        }
        if code in (401, 405):
            (name,) = response["headers"]
            assert fields[name.lower()]


@pytest.mark.parametrize(
    ("error", "code", "kind"),
    [
        (ValueError("a secret"), 500, "failed"),
        (DatabaseError("a secret"), 503, "database"),
        (BusyError("wait"), 503, "too_much"),
        (TooMuchError("wait"), 429, "too_much"),
    ],
)
def test_faults_have_it_too(
    service: Service,
    described: Any,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    code: int,
    kind: str,
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(service.answerer, "health", fail)
    said, fields, content = service.get("/health")
    assert (said, json.loads(content)["error"]["kind"]) == (code, kind)
    assert b"a secret" not in content
    assert ("retry-after" in fields) == (kind == "too_much")
    _check_refusal(described, "/health", code, fields, content)


@pytest.mark.parametrize("what", ["places", "objects"])
def test_pages_are_all_there_is_in_one_order(service: Service, what: str) -> None:
    everything = service.document(f"/state/{what}?limit=1000")[what]
    near = service.document(f"/state/{what}?x=0&y=0&radius=100000000")[what]
    key = f"{what[:-1]}_id"
    assert {thing[key] for thing in near} == {thing[key] for thing in everything}
    for limit in (1, 7, len(everything)):
        pages = list(_pages(service, what, limit))
        assert [thing for page in pages for thing in page] == everything
        assert {len(page) for page in pages[:-1]} <= {limit}
        assert 1 <= len(pages[-1]) <= limit
    nearest = service.document(f"/state/{what}?x=0&y=0&radius=100000000&limit=1")
    assert nearest == {what: near[:1]}
    past = service.document(f"/state/{what}?cursor=99999999999999")
    assert past == {what: [], "next": None}


def _pages(service: Service, what: str, limit: int) -> Iterator[list[Any]]:
    cursor: str | None = "0"
    while cursor is not None:
        page = service.document(f"/state/{what}?limit={limit}&cursor={cursor}")
        yield page[what]
        cursor = page["next"]


def test_pages_while_the_map_grows_have_everything_once(
    one_database: Targets, tmp_path: Path
) -> None:
    seen = documents()
    log = write_log(tmp_path / "log", seen[:20])
    rebuild(log, one_database, described_maps.SETTINGS)
    with Pools(one_database, 1) as pools:
        answerer = Answerer(pools, per_second=10_000.0)
        page = answerer.state("objects", {"limit": "5"})
        before = answerer.state("objects", {})["objects"]
        found = page["objects"]
        write_log(log, seen[20:])
        rebuild(log, one_database, described_maps.SETTINGS)
        while page["next"] is not None:
            page = answerer.state("objects", {"limit": "5", "cursor": page["next"]})
            found += page["objects"]
        after = answerer.state("objects", {})["objects"]
    ids = [thing["object_id"] for thing in found]
    assert len(ids) == len(set(ids))
    stayed = {o["object_id"] for o in before} & {o["object_id"] for o in after}
    assert stayed <= set(ids)
    assert len(after) > len(before) > 5


def test_head_and_options_on_every_path(service: Service) -> None:
    for path in (*PATHS, "/docs", "/openapi.json", "/docs/start.js", "/nothing"):
        code, fields, content = service.get(path, method="HEAD")
        same, _, _ = service.get(path)
        assert (code, content) == (same, b""), path
        code, fields, content = service.get(path, method="OPTIONS")
        assert code == (404 if path == "/nothing" else 405)
        assert json.loads(content)["error"]["kind"] == "bad_question"
        if code == 405:
            assert fields["allow"] == ("POST" if path == "/relocalize" else "GET, HEAD")


TAKEN = {
    "/relocalize": "top, method, session",
    "/state/places": "x, y, radius, limit, cursor",
    "/state/objects": "x, y, radius, limit, cursor",
}
DOCS = ("/openapi.json", "/docs", "/docs/start.js", "/docs/swagger-ui-bundle.js")


@pytest.mark.parametrize("path", [*PATHS, *DOCS, "/docs/swagger-ui.css"])
def test_unknown_parameters_are_refused_on_every_path(
    service: Service, described: Any, path: str
) -> None:
    body = b"{}" if path == "/relocalize" else None
    unknown = f"no parameter called '{{}}'; there are {TAKEN.get(path, 'none')}"
    for query, message in (
        ("tpo=3", unknown.format("tpo")),
        ("_time=1", unknown.format("_time")),
        ("=", unknown.format("")),
        ("a=1&a=2", unknown.format("a")),
    ):
        code, fields, content = service.get(f"{path}?{query}", body)
        refused = {"kind": "bad_question", "message": message}
        assert (code, json.loads(content)["error"]) == (400, refused)
        if path in PATHS:
            _check_refusal(described, path, code, fields, content)
    assert service.get(f"{path}?tpo=3", body, method="HEAD")[2] == b""
    assert service.get(f"{path}/?tpo=3", body)[0] == 404
    assert service.get(f"{path}?tpo=3", method="DELETE")[0] == 405


@pytest.mark.parametrize(
    ("path", "names"), [(path, names.split(", ")) for path, names in TAKEN.items()]
)
def test_empty_and_repeated_parameters_are_refused(
    service: Service, described: Any, path: str, names: list[str]
) -> None:
    body = b"{}" if path == "/relocalize" else None
    for name in names:
        for query, message in (
            (f"{name}=", f"{name} is empty; give a value, or leave {name} out"),
            (f"{name}=1&{name}=1", f"{name} is given 2 times; give it once"),
        ):
            code, fields, content = service.get(f"{path}?{query}", body)
            assert (code, json.loads(content)["error"]["message"]) == (400, message)
            _check_refusal(described, path, code, fields, content)


PREFLIGHT = {"method": "OPTIONS", "Access-Control-Request-Method": "POST"}


class TestOtherSites:
    """CORS: pages of the sites of ``--cors`` may ask, and no others."""

    def test_an_allowed_site_may_read_answers_and_refusals(self, service: Service) -> None:
        for path, secured in (("/health", False), ("/health", True), ("/nothing", False)):
            _, fields, _ = service.get(path, secured=secured, Origin=FRIEND)
            assert fields["access-control-allow-origin"] == FRIEND
            assert "Origin" in fields["vary"]
            assert "access-control-allow-credentials" not in fields

    def test_caches_keep_answers_with_and_without_an_origin_apart(self, service: Service) -> None:
        for headers in ({}, {"Origin": FRIEND}, {"Origin": "https://evil.example"}):
            for path in ("/health", "/nothing"):
                _, fields, _ = service.get(path, **headers)
                assert fields["vary"] == "Origin", (path, headers)

    def test_its_preflight_needs_no_token(self, service: Service) -> None:
        asked = {**PREFLIGHT, "Access-Control-Request-Headers": "authorization,content-type"}
        code, fields, _ = service.get("/relocalize", secured=True, Origin=FRIEND, **asked)
        assert (code, fields["access-control-allow-origin"]) == (200, FRIEND)
        assert "POST" in fields["access-control-allow-methods"]
        assert "Authorization" in fields["access-control-allow-headers"]
        assert "access-control-allow-credentials" not in fields

    def test_a_preflight_for_more_is_refused_in_our_form(self, service: Service) -> None:
        for asked in (
            {**PREFLIGHT, "Access-Control-Request-Method": "DELETE"},
            {**PREFLIGHT, "Access-Control-Request-Headers": "x-evil"},
        ):
            code, _, content = service.get("/relocalize", Origin=FRIEND, **asked)
            assert (code, json.loads(content)["error"]["kind"]) == (403, "refused")

    @pytest.mark.parametrize(
        "origin",
        [
            "https://evil.example",
            "http://map.example",
            "https://map.example:444",
            "https://map.example.evil.example",
            "https://evil.example/https://map.example",
            "https://map.example@evil.example",
            "HTTPS://MAP.EXAMPLE",
            "null",
            "",
            "*",
            "https://map.example\t",
            "https://map.example, https://evil.example",
            "x" * 5000,
        ],
    )
    def test_no_other_site_may_ask(self, service: Service, origin: str) -> None:
        for more in ({}, PREFLIGHT):
            code, fields, _ = service.get("/health", Origin=origin, **more)
            if origin.strip() == FRIEND:  # h11 takes the blanks around a value away
                assert code in (200, 403)
                continue
            assert code == 403
            assert not [name for name in fields if name.startswith("access-control")]

    def test_a_wrong_host_is_refused_before(self, service: Service) -> None:
        code, fields, _ = service.get("/health", Origin=FRIEND, Host="evil.example", **PREFLIGHT)
        assert code == 421
        assert "access-control-allow-origin" not in fields


def test_the_page_loads_nothing_from_elsewhere(service: Service) -> None:
    code, fields, content = service.get("/docs")
    page = content.decode()
    assert (code, fields["content-type"]) == (200, "text/html; charset=utf-8")
    policy = fields["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "script-src 'self';" in policy
    assert "://" not in policy
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert len(loaded) == 5
    for url in loaded:
        assert url.startswith(("/", "data:,"))
        if url.startswith("/"):
            assert service.get(url)[0] == 200
    assert not re.search(r"<script>|<style|\son\w+=", page)
    assert service.get("/redoc")[0] == 404


def test_metrics_count_what_was_asked(service: Service) -> None:
    def numbers() -> dict[str, float]:
        code, fields, content = service.get("/metrics")
        assert (code, fields["content-type"].partition(";")[0]) == (200, "text/plain")
        lines = (line.rpartition(" ") for line in content.decode().splitlines())
        return {name: float(value) for name, _, value in lines if not name.startswith("#")}

    labels = 'question="{}",result="{}",transport="http"'
    answered = f"mapfold_serve_questions_total{{{labels.format('objects', 'answered')}}}"
    wrong = f"mapfold_serve_questions_total{{{labels.format('objects', 'bad_question')}}}"
    missing = 'mapfold_serve_http_responses_total{status="404"}'
    took = 'mapfold_serve_question_seconds_count{question="objects",transport="http"}'
    before = numbers()
    service.document("/state/objects")
    service.get("/state/objects?x=1")
    service.get("/nothing")
    after = numbers()
    for name, more in ((answered, 1), (wrong, 1), (missing, 1), (took, 2)):
        assert after[name] - before.get(name, 0.0) == more, name
    assert after["mapfold_serve_database_up"] == 1
    assert after["mapfold_serve_queue_size"] == 64
