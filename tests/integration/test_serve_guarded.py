"""HTTP access control of `mapfold serve`: token, TLS, the Host and Origin headers."""

import json
import os
import re
import ssl
from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from projections.fold.settings import Settings
from projections.postgres import rebuild
from projections.postgres.connection import Targets
from projections.surfaces.serve.guard import read_origin, read_token
from tests.support.commands import Commands
from tests.support.fixtures_zenoh import Certificate
from tests.support.http_attacks import answer, ask, connect, request, served, status
from tests.support.logs import walk, write_log

TOKEN = "0123456789abcdef-not-a-secret"
BEARER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory, module_database: Targets) -> tuple[str, ...]:
    log = write_log(tmp_path_factory.mktemp("map") / "log", walk(10, seed=3))
    rebuild(log, module_database, Settings())
    return "--no-zenoh", "--db", module_database.graph_url


@pytest.fixture
def token_file(tmp_path: Path) -> Path:
    file = tmp_path / "token"
    file.touch(0o600)
    file.write_text(f"{TOKEN}\n")
    return file


def get(port: int, path: str = "/health", **headers: str) -> tuple[int, Any]:
    got = ask(port, request("GET", path, headers=headers))
    return status(got), json.loads(got.partition(b"\r\n\r\n")[2])


class TestOffLoopback:
    """``--http 0.0.0.0``: others can reach it."""

    def test_it_does_not_start_without_a_token(self, mapfold: Commands) -> None:
        for http in ("0.0.0.0:0", "[::]:0"):
            said = mapfold("serve", "--no-zenoh", "--http", http, code=2)
            assert said.err.startswith(f"mapfold: --http {http} can be reached by others")
            assert "--token-file FILE or MAPFOLD_TOKEN" in said.err

    def test_the_token_is_required_and_missing_tls_warned_of(
        self, base: tuple[str, ...], token_file: Path
    ) -> None:
        args = (*base, "--http", "0.0.0.0:0", "--token-file", str(token_file))
        with served(*args) as service:
            assert service.said[0].startswith("warning: --http 0.0.0.0:0 without TLS: ")
            assert TOKEN not in service.text
            assert get(service.port, **BEARER) == (200, {"status": "ok"})
            got = ask(
                service.port,
                request("GET", "/health", headers={"Host": "127.0.0.5", **BEARER}),
                to="127.0.0.5",
            )  # the address that was connected to
            assert status(got) == 200
            for path in ("/health", "/docs", "/openapi.json", "/state/places?x=0&y=0", "/nothing"):
                got = ask(service.port, request("GET", path))
                assert status(got) == 401
                assert b'\r\nwww-authenticate: Bearer realm="mapfold"\r\n' in got.lower().replace(
                    b"bearer", b"Bearer"
                )
            for wrong in ("", "Bearer", "Bearer ", f"Basic {TOKEN}", f"Bearer {TOKEN[:-1]}"):
                code, document = get(service.port, Authorization=wrong)
                assert (code, document["error"]["kind"]) == (401, "refused")
                assert TOKEN not in document["error"]["message"]


def test_a_token_of_the_environment_is_required_on_loopback_too(
    base: tuple[str, ...],
) -> None:
    with served(*base, "--http", "127.0.0.1:0", MAPFOLD_TOKEN=TOKEN) as service:
        assert "warning" not in service.text
        assert get(service.port)[0] == 401
        assert get(service.port, **BEARER)[0] == 200


def test_tls(base: tuple[str, ...], token_file: Path, certificate: Certificate) -> None:
    args = ("--tls-cert", str(certificate.cert), "--tls-key", str(certificate.key))
    args += ("--http", "0.0.0.0:0", "--token-file", str(token_file))
    client = ssl.create_default_context(cafile=str(certificate.cert))
    with served(*base, *args) as service:
        assert "warning" not in service.text
        assert re.search(r"answering https://0\.0\.0\.0:\d+", service.text)
        with client.wrap_socket(connect(service.port), server_hostname="localhost") as secured:
            secured.sendall(request("GET", "/health", headers=BEARER))
            assert status(answer(secured)) == 200
        assert ask(service.port, request("GET", "/health", headers=BEARER)) == b""


class TestNames:
    """The Host and Origin headers, against web pages that ask behind their reader's back."""

    @pytest.fixture
    def port(self, base: tuple[str, ...]) -> Any:
        args = ("--http", "127.0.0.1:0", "--allow-host", "Map.example")
        with served(*base, *args) as service:
            yield service.port

    def test_names(self, port: int) -> None:
        for host in ("127.0.0.1", f"127.0.0.1:{port}", "LOCALHOST:80", "[::1]", "map.example:443"):
            assert get(port, Host=host)[0] == 200
        wrong = ("evil.example", "127.0.0.1.evil.example", "localhost@evil", "", "[", "[::1", ":80")
        for host in (*wrong, "localhost:x", "localhost/evil", "192.0.2.1", "localhost#", "a b"):
            code, document = get(port, Host=host)
            assert code in (400, 421)
            assert document["error"]["kind"] == ("refused" if code == 421 else "bad_question")
        for origin in (f"http://127.0.0.1:{port}", f"HTTP://127.0.0.1:{port}"):
            assert get(port, Host=f"127.0.0.1:{port}", Origin=origin)[0] == 200
        for origin in (
            "http://evil.example",
            "null",
            "",
            "http://127.0.0.1",
            "http://[",
            "file://",
        ):
            code, document = get(port, Host=f"127.0.0.1:{port}", Origin=origin)
            assert (code, document["error"]["kind"]) == (403, "refused")


class TestMisuse:
    """What is wrong is said before a database is opened, in one line, with exit 2."""

    @pytest.mark.parametrize(
        ("content", "said"),
        [
            ("", "the token has 0 characters, fewer than 16; make one with"),
            ("\n", "the token has 0 characters"),
            ("short\n", "the token has 5 characters"),
            ("0123456789 abcdef", "one line of printable ASCII without spaces"),
            ("0123456789abcdef\n0123", "one line of printable ASCII without spaces"),
            ("0123456789abcdéf", "one line of printable ASCII without spaces"),
        ],
    )
    def test_a_malformed_token_is_refused(self, tmp_path: Path, content: str, said: str) -> None:
        file = tmp_path / "wrong"
        file.write_text(content)
        with pytest.raises(MisuseError) as refused:
            read_token(file, {}, print)
        assert said in str(refused.value)
        assert not content.strip() or content.strip() not in str(refused.value)

    def test_a_token_of_the_command_line_is_looked_at(self, mapfold: Commands) -> None:
        (mapfold.folder / "wrong").write_text("short")
        args = ("serve", "--no-zenoh", "--http", "127.0.0.1:0", "--token-file", "wrong")
        said = mapfold(*args, code=2).err
        assert "the token has 5 characters" in said
        assert "short" not in said

    def test_a_fifo_in_place_of_a_token_file_blocks_nothing(self, mapfold: Commands) -> None:
        os.mkfifo(mapfold.folder / "fifo")
        args = ("serve", "--no-zenoh", "--http", "127.0.0.1:0", "--token-file", "fifo")
        assert "--token-file fifo: not a regular file" in mapfold(*args, code=2).err

    def test_an_empty_token_in_the_environment(self, tmp_path: Path) -> None:
        mapfold = Commands.in_folder(tmp_path, MAPFOLD_TOKEN="")
        said = mapfold("serve", "--no-zenoh", "--http", "0.0.0.0:0", code=2).err
        assert "MAPFOLD_TOKEN of the environment: the token has 0 characters" in said

    def test_a_token_file_that_others_may_read_is_warned_of(
        self, mapfold: Commands, token_file: Path
    ) -> None:
        token_file.chmod(0o644)
        args = ("serve", "--no-zenoh", "--http", "127.0.0.1:99999", "--token-file", token_file)
        assert "--http 127.0.0.1:99999: write it as HOST:PORT" in mapfold(*args, code=2).err
        args = ("serve", "--no-zenoh", "--http", "127.0.0.1:0", "--token-file", token_file)
        said = mapfold(*args, "--db", "postgresql://127.0.0.1:1/none", code=1).err
        assert f"other users may read it; run chmod 600 {token_file}" in said.replace("\n", " ")

    def test_options_that_need_another_are_refused(
        self, mapfold: Commands, certificate: Certificate, token_file: Path
    ) -> None:
        for option, value in (
            ("--token-file", token_file),
            ("--tls-cert", certificate.cert),
            ("--tls-key", certificate.key),
            ("--allow-host", "robot"),
            ("--cors", "https://map.example"),
        ):
            said = mapfold("serve", option, value, code=2).err
            assert said == f"mapfold: {option} is for HTTP; give --http HOST:PORT too\n"
        for option, file in (("--tls-cert", certificate.cert), ("--tls-key", certificate.key)):
            said = mapfold("serve", "--http", "127.0.0.1:0", option, file, code=2).err
            assert "need each other" in said

    def test_invalid_certificate_files_are_refused(
        self, mapfold: Commands, certificate: Certificate
    ) -> None:
        def said(cert: Path, key: Path) -> str:
            args = ("serve", "--http", "127.0.0.1:0", "--tls-cert", cert, "--tls-key", key)
            return mapfold(*args, code=2).err

        missing = mapfold.folder / "missing"
        assert f"--tls-cert {missing}: No such file" in said(missing, certificate.key)
        assert f"--tls-key {missing}: No such file" in said(certificate.cert, missing)
        assert "give a certificate and its key" in said(certificate.key, certificate.key)
        assert "give a certificate and its key" in said(certificate.cert, certificate.cert)
        assert (
            "--token-file"
            in mapfold("serve", "--http", "127.0.0.1:0", "--token-file", missing, code=2).err
        )

    @pytest.mark.parametrize(
        "origin",
        [
            "*",
            "null",
            "",
            "map.example",
            "ftp://map.example",
            "https://",
            "https://map.example/page",
            "https://map.example?x",
            "https://ann@map.example",
            "https://map.example:x",
            "https://*.example",
            "https://map.example:99999",
            "https://[::1",
            "https://map example",
        ],
    )
    def test_what_is_no_origin_is_refused(self, origin: str) -> None:
        with pytest.raises(MisuseError, match=r"\* is not taken") as refused:
            read_origin(origin)
        wrong = f"--cors {origin}: write an origin as a browser sends it"
        assert str(refused.value).startswith(wrong)

    def test_an_origin_of_the_command_line_is_looked_at(self, mapfold: Commands) -> None:
        args = ("serve", "--no-zenoh", "--http", "127.0.0.1:0", "--cors", "*")
        said = mapfold(*args, code=2).err
        assert said.startswith("mapfold: --cors *: write an origin as a browser sends it")


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ("https://map.example", "https://map.example"),
        ("HTTPS://Map.Example:443/", "https://map.example"),
        ("http://localhost:5173", "http://localhost:5173"),
        ("http://localhost:80", "http://localhost"),
        ("https://localhost:80", "https://localhost:80"),
        ("http://[::1]:8000", "http://[::1]:8000"),
    ],
)
def test_an_origin_is_written_as_browsers_send_it(given: str, sent: str) -> None:
    assert read_origin(given) == sent
