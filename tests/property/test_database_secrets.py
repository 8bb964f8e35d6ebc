"""Whatever is given as a database's URL, a password in it is never shown."""

import contextlib
import io
import string
from collections.abc import Iterator
from pathlib import Path
from unittest import mock

import psycopg
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from psycopg.conninfo import conninfo_to_dict

from eventsrc.base.errors import MapfoldError
from projections.fold.settings import Settings
from projections.postgres.connection import Targets, connect, describe_target, open_targets
from projections.postgres.status import projection_status
from tests.support.commands import Commands
from tests.support.logs import walk, write_log
from tests.support.thorough import examples

SECRET = "Zq7SECRETx"
PARTS = st.sampled_from(
    [
        SECRET, "postgresql://", "postgres://", "host=127.0.0.1 ", "password=", "user=", "u", ":",
        "@", "/", "?", "&", "#", "%", "%40", "%00", "=", "'", " ", ",", "[::1]", "127.0.0.1", ":1",
        ":12", "/db", "sslmode=", "port=", "dbname=", "options=", "passfile=", "foo=bar", "\\",
        "\0", "\n", "connect_timeout=1", "service=", "hostaddr=", "keepalives_idle=", "é",
    ]
)  # fmt: skip
GIVEN = st.one_of(
    st.lists(PARTS, min_size=1, max_size=12).map(lambda parts: "".join(parts) + SECRET),
    st.lists(PARTS, min_size=1, max_size=12).map(lambda parts: SECRET.join(["", *parts])),
    st.text(string.printable, max_size=30).map(
        lambda text: f"postgresql://u:{text}{SECRET}{text}@127.0.0.1:1/db"
    ),
    st.text(string.printable, max_size=30).map(
        lambda text: f"postgresql://127.0.0.1:1/db?{text}{SECRET}{text}"
    ),
)
KNOWN = [
    f"host=h password={SECRET}",
    f"postgresql://127.0.0.1:1/db?password={SECRET}&foo=bar",
    f"postgresql://u:a/{SECRET}@127.0.0.1:1/db",
    f"postgresql://u:12/{SECRET}@127.0.0.1:1/db",
    f"postgresql://u:a@{SECRET}@127.0.0.1:1/db",
    f"postgresql://u:100%{SECRET}@127.0.0.1:1/db",
    f"postgresql://u:{SECRET}",
    f"postgresql://127.0.0.1:1/db?sslmode={SECRET}",
    f"mysql://u:{SECRET}@127.0.0.1/db",
    SECRET,
]


@contextlib.contextmanager
def _no_network() -> Iterator[None]:
    """A host that is none of this machine is not looked up; libpq still reads the rest."""
    real = psycopg.connect

    def only_here(conninfo: str, **options: object) -> psycopg.Connection:
        said = conninfo_to_dict(conninfo)
        away = {"host": "127.0.0.1", "hostaddr": "", "port": "1", "service": ""}
        local = {name: value for name, value in away.items() if name in said or name == "host"}
        return real(conninfo, **{**options, **local})  # type: ignore[arg-type]

    with mock.patch.object(psycopg, "connect", only_here):
        yield


def shown(url: str) -> str:
    """All that the library says of a URL."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), _no_network():
        try:
            with open_targets(url, url) as targets:
                said.write(f"{targets!r} {describe_target(url)}")
                connect(targets.graph_url).close()
        except MapfoldError as error:
            said.write(f"{error} {error!r}")
    return said.getvalue()


def public(url: str) -> bool:
    """Whether the secret is in the host, where it is plainly no password."""
    try:
        said = conninfo_to_dict(url)
    except (psycopg.Error, ValueError):
        return False
    return any(SECRET in str(said.get(name)) for name in ("host", "port", "dbname", "user"))


@settings(max_examples=examples(400), deadline=None)
@given(GIVEN)
@example(KNOWN[0])
@example(KNOWN[1])
@example(KNOWN[2])
@example(KNOWN[3])
@example(KNOWN[4])
@example(KNOWN[5])
@example(KNOWN[6])
@example(KNOWN[7])
def test_no_part_of_what_cannot_be_parsed_is_shown(url: str) -> None:
    said = shown(url)
    if SECRET in said:
        assert public(url)
        assert "not a PostgreSQL URL" not in said


@pytest.mark.parametrize("url", KNOWN)
def test_known_ways_to_write_it_wrong(url: str) -> None:
    assert SECRET not in shown(url)


@pytest.mark.parametrize("variable", ["MAPFOLD_DB", "MAPFOLD_VECTOR_DB"])
def test_from_the_environment(variable: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(variable, f"host=h password={SECRET}")
    with pytest.raises(MapfoldError, match=f"^{variable}: not a PostgreSQL URL") as caught:
        open_targets().__enter__()
    assert SECRET not in str(caught.value)


def test_a_password_in_the_environment_or_a_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passes = tmp_path / "pgpass"
    passes.write_text(f"*:*:*:*:{SECRET}\n")
    passes.chmod(0o600)
    log = write_log(tmp_path / "log", walk(1))
    url = "postgresql://u@127.0.0.1:1/db"
    for name, value in (("PGPASSFILE", str(passes)), ("PGPASSWORD", SECRET)):
        monkeypatch.setenv(name, value)
        assert SECRET not in shown(url)
        assert SECRET not in repr(projection_status(log, Targets(url, url), Settings()))


CALLS = [
    ("status", "log", "--db", KNOWN[0]),
    ("status", "log", "--db", KNOWN[1], "--json"),
    ("status", "log", "--db", "host=h", f"password={SECRET}"),
    ("status", "log", "--db", "postgresql://u:a", f"{SECRET}@h/db"),
    ("status", "log", f"postgresql://u:{SECRET}@h/db"),
    (f"postgresql://u:{SECRET}@h/db",),
    ("replay", "log", "--only", f"postgresql://u:{SECRET}@h/db"),
    ("status", "log", f"--dbb=postgresql://u:{SECRET}@h/db"),
]


@pytest.mark.parametrize("call", CALLS)
def test_commands_do_not_repeat_it(tmp_path: Path, call: tuple[str, ...]) -> None:
    write_log(tmp_path / "log", walk(1))
    said = Commands.in_folder(tmp_path)(*call, code=2)
    assert said.err
    assert SECRET not in said.out + said.err


def test_a_server_that_is_down_is_told_without_the_password(tmp_path: Path) -> None:
    write_log(tmp_path / "log", walk(1))
    mapfold = Commands.in_folder(tmp_path)
    for form in ((), ("--json",)):
        url = f"postgresql://u:{SECRET}@127.0.0.1:1/db"
        said = mapfold("status", "log", "--db", url, *form, code=3)
        assert "database db at 127.0.0.1:1" in said.out
        assert SECRET not in said.out + said.err


def test_an_ordinary_usage_error_is_still_told_in_full(tmp_path: Path) -> None:
    said = Commands.in_folder(tmp_path)("status", "log", "surplus", code=2)
    assert "(surplus)" in said.err
