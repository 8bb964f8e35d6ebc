"""Who may ask `mapfold ui`, and what comes back for what no honest page sends."""

import json
import re
import socket
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.text import visible
from eventsrc.envelope.system_events import LOSS_KEY, REJECTED_KEY
from projections.surfaces.ui.live_watch import MOST_STREAMS
from tests.support.commands import Commands
from tests.support.envelopes import detection, envelope
from tests.support.http_attacks import answer, request, status
from tests.support.logs import append_raw, walk, write_log
from tests.support.ui_page import UiServer, read_arrays, showing

CSP = (
    "default-src 'self'; img-src 'self' data: blob:; object-src 'none'; base-uri 'none';"
    " form-action 'none'; frame-ancestors 'none'"
)


@pytest.fixture(scope="module")
def mapfold(tmp_path_factory: pytest.TempPathFactory) -> Commands:
    return Commands.in_folder(tmp_path_factory.mktemp("guarded"))


@pytest.fixture(scope="module")
def log(mapfold: Commands) -> Path:
    return write_log(mapfold.folder / "log", walk(40, seed=4))


@pytest.fixture(scope="module")
def server(mapfold: Commands, log: Path) -> Iterator[UiServer]:
    with showing(mapfold, log) as started:
        yield started


@pytest.fixture(scope="module")
def editing(mapfold: Commands, log: Path) -> Iterator[UiServer]:
    with showing(mapfold, log, "--allow-edits") as started:
        yield started


@pytest.fixture(scope="module")
def exposed(mapfold: Commands, log: Path) -> Iterator[UiServer]:
    with showing(mapfold, log, "--host", "0.0.0.0", "--allow-edits") as started:
        yield started


def raw(server: UiServer, sent: bytes) -> bytes:
    """What comes back for these bytes."""
    with socket.create_connection(("127.0.0.1", server.port), 30.0) as connection:
        connection.sendall(sent)
        return answer(connection)


class TestOnLoopback:
    def test_it_listens_there_only_and_needs_no_token_to_read(self, server: UiServer) -> None:
        assert server.token is None
        listening = Path(f"/proc/{server.program.pid}/net/tcp").read_text()
        assert f"0100007F:{server.port:04X}" in listening
        assert f"00000000:{server.port:04X}" not in listening
        assert server.api("log")["token_needed"] is False

    @pytest.mark.parametrize(
        "host", ["evil.example", "127.0.0.1.evil.example", "evil.example:80", "", "[", "a b", "@"]
    )
    def test_a_foreign_host_is_refused(self, server: UiServer, host: str) -> None:
        for path in ("/", "/api/log", "/api/history", "/nothing"):
            got = raw(server, request("GET", path, headers={"Host": host}))
            assert status(got) in (400, 421)
            assert b'"run' not in got

    @pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
    def test_a_foreign_origin_is_refused(self, server: UiServer, origin: str) -> None:
        for path in ("/api/log", "/api/history", "/api/digest"):
            got = server.ask(path, headers={"Origin": origin})
            assert got.error[:2] == (403, "refused")
        own = {"Origin": f"http://127.0.0.1:{server.port}"}
        assert server.ask("/api/log", headers=own).status == 200

    @pytest.mark.parametrize("site", ["cross-site", "same-site"])
    def test_a_question_of_another_page_is_refused(self, server: UiServer, site: str) -> None:
        headers = {"Sec-Fetch-Site": site}  # without Origin: an image or a script
        assert server.ask("/api/log", headers=headers).error[:2] == (403, "refused")
        assert server.ask("/", headers=headers).status == 200  # a link to the page
        for fine in ("same-origin", "none"):
            assert server.ask("/api/log", headers={"Sec-Fetch-Site": fine}).status == 200

    def test_nothing_can_be_changed(self, server: UiServer, log: Path) -> None:
        before = log_bytes(log)
        got = server.edit("forget-run", "run-a", reason="x", dry_run=False)
        assert got.error[:2] == (403, "refused")
        assert "--allow-edits" in got.error[2]
        for method in ("PUT", "DELETE", "PATCH", "POST"):
            assert server.ask("/api/history", method=method).status == 405
        assert log_bytes(log) == before


def log_bytes(log: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in log.glob("*.mcap")}


class TestEdits:
    @pytest.mark.parametrize(
        "headers",
        [
            {},
            {"Authorization": "Bearer wrong"},
            {"Authorization": "Basic {token}"},
            {"Authorization": "{token}"},
            {"Cookie": "mapfold_{port}={token}"},
        ],
    )
    def test_an_edit_needs_the_token_in_its_header(
        self, editing: UiServer, log: Path, headers: dict[str, str]
    ) -> None:
        before = log_bytes(log)
        filled = {
            name: value.format(token=editing.token, port=editing.port)
            for name, value in headers.items()
        }
        body = json.dumps({"kind": "forget-run", "arguments": ["run-a"], "reason": "x"}).encode()
        for path in ("/api/edit", "/api/edit/", f"/api/edit?token={editing.token}"):
            got = editing.ask(path, method="POST", body=body, headers=filled)
            assert got.error[:2] == (401, "refused")
            assert str(editing.token) not in got.body.decode()
        assert log_bytes(log) == before

    def test_not_with_a_foreign_origin_even_with_the_token(self, editing: UiServer) -> None:
        headers = {"Authorization": f"Bearer {editing.token}", "Origin": "http://evil.example"}
        got = editing.ask("/api/edit", method="POST", body=b"{}", headers=headers)
        assert got.error[:2] == (403, "refused")

    def test_an_edit_takes_no_parameters(self, editing: UiServer) -> None:
        bearer = {"Authorization": f"Bearer {editing.token}"}
        got = editing.ask("/api/edit?dry_run=0", method="POST", body=b"{}", headers=bearer)
        said = "no parameter called 'dry_run'; there are token"
        assert got.error == (400, "bad_question", said)

    def test_reading_needs_no_token(self, editing: UiServer) -> None:
        assert editing.api("log")["edits_allowed"] is True
        assert len(str(editing.token)) >= 32


class TestOffLoopback:
    def test_everything_needs_the_token(self, exposed: UiServer) -> None:
        assert exposed.said[0].startswith("warning: others can reach 0.0.0.0")
        assert exposed.host == "127.0.0.1"  # no browser need know what 0.0.0.0 is
        assert exposed.said[2].startswith("from another machine, put an address of this one")
        for path in ("/", "/index.html", "/api/log", "/api/live", "/openapi.json", "/nothing"):
            for wrong in ("", "?token=", "?token=wrong", f"?token={str(exposed.token)[:-1]}"):
                got = exposed.ask(path + wrong)
                assert got.error[:2] == (401, "refused"), path
                assert "set-cookie" not in got.headers

    def test_the_link_sets_a_cookie_that_serves_for_the_rest(self, exposed: UiServer) -> None:
        page = exposed.ask(f"/?token={exposed.token}")
        assert page.status == 200
        cookie, *attributes = page.headers["set-cookie"].split("; ")
        assert set(attributes) == {"HttpOnly", "SameSite=Strict", "Path=/"}
        assert exposed.ask("/api/log", headers={"Cookie": cookie}).status == 200
        assert exposed.ask("/api/log", headers={"Cookie": f"{cookie}x"}).status == 401
        bearer = {"Authorization": f"Bearer {exposed.token}"}
        assert exposed.ask("/api/log", headers=bearer).json["token_needed"] is True
        got = exposed.ask("/api/edit", method="POST", body=b"{}", headers={"Cookie": cookie})
        assert got.error[:2] == (401, "refused")

    def test_a_token_is_new_each_time(self, exposed: UiServer, editing: UiServer) -> None:
        assert exposed.token != editing.token


@pytest.mark.parametrize(
    "path",
    [
        "/../../../../etc/passwd",
        "/..%2f..%2f..%2fetc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
        "/static/../service.py",
        "/../service.py",
        "//etc/passwd",
        "/.gitkeep",
        "/assets/..\\..\\service.py",
        "/index.html%00.js",
        "/" + "a" * 5000,
    ],
)
def test_only_the_pages_own_files_can_be_had(server: UiServer, path: str) -> None:
    got = raw(server, request("GET", path))
    assert status(got) in (400, 404)
    assert b"root:" not in got
    assert b"import" not in got


def test_every_answer_has_safe_headers(server: UiServer, exposed: UiServer) -> None:
    answers = [server.ask(path) for path in ("/", "/api/log", "/api/nothing", "/api/digest?at=x")]
    answers += [exposed.ask("/"), server.ask("/api/log", headers={"Origin": "null"})]
    for got in answers:
        assert got.headers["content-security-policy"] == CSP
        assert got.headers["x-content-type-options"] == "nosniff"
        assert got.headers["referrer-policy"] == "no-referrer"
        assert "access-control-allow-origin" not in got.headers
        assert "server" not in got.headers
    for sent in (b"no HTTP\r\n\r\n", b"GET / HTTP/1.1\r\nX: " + b"y" * 99_999 + b"\r\n\r\n"):
        refused = raw(server, sent).lower()
        assert b"content-security-policy: default-src 'none'" in refused
        assert b"x-content-type-options: nosniff" in refused
    assert server.ask("/api/log").headers["cache-control"] == "no-store"
    page = server.ask("/")
    assert page.headers["content-type"].startswith("text/html")
    again = server.ask("/", headers={"If-None-Match": page.headers["etag"]})
    assert (again.status, again.body) == (304, b"")


def test_there_is_no_page_that_loads_from_other_hosts(server: UiServer) -> None:
    assert server.ask("/redoc").status == 404
    docs = server.ask("/docs")
    assert b"/api/whatif" in docs.body
    for page in (docs, server.ask("/")):
        assert page.headers["content-type"].startswith("text/html")
        assert not re.search(rb"""(src|href)=["']?(https?:|//)""", page.body)
        assert not re.search(rb"<script>|<style|style=| on\w+=", page.body)


def test_a_link_with_the_token_is_in_no_cache(exposed: UiServer, editing: UiServer) -> None:
    for server in (exposed, editing):
        assert server.ask("/", token=server.token).headers["cache-control"] == "no-store"
    assert editing.ask("/").headers["cache-control"] == "no-cache"


def test_many_pages_follow_and_one_more_is_told(mapfold: Commands, log: Path) -> None:
    with showing(mapfold, log) as server, ExitStack() as stack:
        for _ in range(MOST_STREAMS):
            assert next(stack.enter_context(server.live()))["through"] == 40
        got = server.ask("/api/live")
        assert got.error[:2] == (503, "too_much")
        assert f"{MOST_STREAMS} pages" in got.error[2]
        assert server.api("digest")["at"] == 40
        stack.pop_all().close()
        with server.live() as heard:
            assert next(heard)["through"] == 40


class TestHugeQuestions:
    def test_a_huge_body(self, editing: UiServer) -> None:
        bearer = {"Authorization": f"Bearer {editing.token}"}
        for path, size in (("/api/relocalize", 2_000_000), ("/api/edit", 200_000)):
            got = editing.ask(path, method="POST", body=b"[" * size, headers=bearer)
            assert got.error[:2] == (400, "bad_question")
            assert "bytes" in got.error[2]

    def test_a_body_that_nests_deeply(self, editing: UiServer) -> None:
        bearer = {"Authorization": f"Bearer {editing.token}"}
        got = editing.ask("/api/edit", method="POST", body=b"[" * 60_000, headers=bearer)
        assert got.error[:2] == (400, "bad_question")

    def test_chunks_and_endless_heads(self, server: UiServer) -> None:
        head = {"Transfer-Encoding": "chunked"}
        assert status(raw(server, request("POST", "/api/relocalize", headers=head))) in (400, 411)
        long = {"X": "y" * 3_000_000}
        assert status(raw(server, request("GET", "/api/log", headers=long))) in (400, 431)

    def test_many_settings_and_alternatives(self, server: UiServer) -> None:
        many = [f"eps_m={i}" for i in range(1, 60)]
        assert server.ask("/api/digest", set=many).error[:2] == (400, "bad_settings")
        grid = ["eps_m=" + ",".join(map(str, range(1, 300)))]
        assert server.ask("/api/whatif", grid=grid).error[:2] == (400, "bad_settings")

    def test_a_long_condition(self, server: UiServer) -> None:
        for text in ("not " * 3000 + "true", "(" * 3000, "place_count() < 1 or " * 400 + "x"):
            got = server.ask("/api/bisect", condition=text)
            assert got.status in (200, 400, 431), got.body[:300]
        assert server.api("log")["through"] == 40


HOSTILE = [
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "\u202egnp.exe\u2066",
    "שלום עולם",
    "🤖👩\u200d🚀",
    "x" * 256,
    "'; DROP TABLE places; --",
    "a/b:c?d#e&f=%00",
]


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Iterator[UiServer]:
    mapfold = Commands.in_folder(tmp_path_factory.mktemp("hostile"))
    documents = [
        envelope(
            k, float(x), 0.0, run_id=name[:200],
            detections=[detection(name[:200], [1.0, float(n)], det_id=f"{name[:200]}-{k}")],
        )
        for n, name in enumerate(HOSTILE)
        for k, x in enumerate((n * 10.0, n * 10.0 + 0.1, n * 10.0 + 0.2))
    ]  # fmt: skip
    log = write_log(mapfold.folder / "log <b>", documents)
    with showing(mapfold, log, "--allow-edits") as started:
        yield started


def texts_of(answer: dict[str, Any]) -> Iterator[str]:
    """What an answer says to people: not the ids, which are exact."""
    for field in ("summary", "effect_text", "message", "command"):
        if field in answer:
            yield answer[field]
    for field in ("lines", "notes", "problems"):
        yield from answer.get(field, ())
    for step in answer.get("steps", ()):
        yield step["text"]


class TestHostileNames:
    """What a log holds comes back as it is, as JSON text."""

    def test_ids_and_classes(self, hostile: UiServer) -> None:
        got = hostile.ask("/api/history")
        header, _ = read_arrays(got.body)
        names = [name[:200] for name in HOSTILE]
        assert header["strings"]["run_id"] == names
        assert header["strings"]["class"] == names
        assert header["strings"]["place_id"] == [f"{name}_p0" for name in names]
        assert got.headers["content-type"] == "application/octet-stream"
        assert [run["run_id"] for run in hostile.api("log")["runs"]] == names

    @pytest.mark.parametrize("name", [name[:200] for name in HOSTILE])
    def test_stories_and_searches(self, hostile: UiServer, name: str) -> None:
        for what in (f"place:{name}_p0", f"keyframe:{name}/1"):
            got = hostile.ask("/api/why", what=what)
            assert got.status == 200, got.body
            assert got.headers["content-type"] == "application/json"
            assert got.json["subject"] == what.partition(":")[2].replace(f"{name}/", f"{name}:")
        found = hostile.api("search", q=name)["found"]
        assert {"run", "object"} <= {each["kind"] for each in found}
        called = hostile.ask("/api/why", what=f"object:{name}").json  # by its class, the only one
        assert called["subject"] in {each["id"] for each in found if each["kind"] == "object"}
        missing = hostile.ask("/api/why", what=f"object:{name}{name}")
        assert missing.json["error"]["kind"] == "not_found"

    def test_texts_for_people_turn_no_direction(self, hostile: UiServer) -> None:
        """The page shows them as they are; names are in them between other words."""
        name = HOSTILE[2]
        offset = str(HOSTILE.index(name) * 3 + 3)
        answers = [
            hostile.api("why", what=f"place:{name}_p0"),
            hostile.api("why", what=f"keyframe:{name}/2"),
            hostile.api("diff", **{"from": "0", "to": offset}),
            hostile.api("bisect", condition=f"size('{name}_p0') > 1"),
            hostile.api("whatif", eps_m="0.1"),
            hostile.api("corrections"),
            hostile.edit("name-place", f"{name}_p0", name).json,
            hostile.ask("/api/why", what=f"place:{name}{name}").json["error"],
        ]
        texts = [text for answer in answers for text in texts_of(answer)]
        assert any(ascii(name)[1:-1] in text for text in texts)
        assert [text for text in texts if visible(text) != text] == []

    def test_what_mapfold_itself_never_writes(self, mapfold: Commands, tmp_path: Path) -> None:
        """Half a surrogate pair in events of mapfold's own keys, as an imported log may have."""
        log = write_log(tmp_path / "log", walk(5))
        append_raw(log, rb'{"key": "\ud800", "reason": "\udfff"}', key=REJECTED_KEY)
        loss = {"publisher": "\ud800", "first": 1, "last": 2, "count": 2, "cause": "queue_full"}
        append_raw(log, json.dumps(loss).encode(), key=LOSS_KEY)
        with showing(mapfold, log) as server:
            header, arrays = read_arrays(server.ask("/api/history").body)
            assert len(header["system"]) == 2
            assert len(arrays["kf_x"]) == 5

    def test_a_name_and_a_reason(self, hostile: UiServer) -> None:
        place = f"{HOSTILE[0]}_p0"
        for name in (HOSTILE[0], HOSTILE[3], "kitchen 🍳", "-rf"):
            got = hostile.edit("name-place", place, name, reason=HOSTILE[1], dry_run=False)
            assert got.json["recorded"] is True
        listed = hostile.api("corrections")["corrections"]
        assert {each["reason"] for each in listed} == {HOSTILE[1]}
        header, _ = read_arrays(hostile.ask("/api/history").body)
        assert header["names"][-1]["name"] == "-rf"
        assert [each["kind"] for each in header["system"]] == ["correction"] * 4
