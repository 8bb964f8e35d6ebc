"""What `mapfold serve` refuses over HTTP: each refusal has the one shape that is described."""

import json
from typing import Any

import pytest
from pydantic import TypeAdapter

from projections.fold.map_errors import DatabaseError
from projections.surfaces.serve import models
from projections.surfaces.serve.answering import BusyError, TooMuchError
from tests.support.services import FRIEND, PATHS, Service

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
    (411, "/health", None, {"Transfer-Encoding": "chunked"}),
    (411, "/metrics", None, {"Transfer-Encoding": "gzip"}),
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
    TypeAdapter(models.RefusalShape).validate_json(content, strict=True, extra="forbid")
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
MONITORED = ("/health", "/metrics")


@pytest.mark.parametrize("path", MONITORED)
def test_monitors_may_add_parameters(service: Service, path: str) -> None:
    assert service.get(f"{path}?module=mapfold&_=17&_=18&empty=")[0] == service.get(path)[0] == 200


@pytest.mark.parametrize("path", [*sorted({*PATHS} - {*MONITORED}), *DOCS, "/docs/swagger-ui.css"])
def test_unknown_parameters_are_refused_on_every_other_path(
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
