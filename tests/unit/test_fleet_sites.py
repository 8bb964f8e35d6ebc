"""Which sites there are, and which database each has."""

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from psycopg.conninfo import conninfo_to_dict

from eventsrc.base.errors import MisuseError
from projections.adapters.fleet.site_databases import site_databases
from projections.adapters.fleet.sites import MAX_LIST_BYTES, Site, find_sites
from tests.support.envelopes import envelope
from tests.support.logs import write_log


def _sites(place: Path) -> tuple[list[tuple[str, Path]], list[str]]:
    notes: list[str] = []
    return [(site.name, site.log) for site in find_sites(place, notes.append)], notes


def _log(path: Path) -> Path:
    return write_log(path, [envelope(0, 0.0, 0.0)])


def test_a_folder_has_a_site_in_each_subfolder_with_a_log(tmp_path: Path) -> None:
    for name in ("kitchen", "Büro 2", "a"):
        _log(tmp_path / name)
    for name in ("empty", "a.history", "kitchen.history"):  # caches beside a log are not named
        (tmp_path / name).mkdir()
    (tmp_path / "notes.txt").write_text("x")
    _log(tmp_path / ".mapfold")  # hidden, as the embedded server's folder is
    (tmp_path / "nowhere").symlink_to(tmp_path / "absent")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "linked").symlink_to(tmp_path / "a")
    (tmp_path / "above").symlink_to(tmp_path)

    found, notes = _sites(tmp_path)

    names = ["Büro 2", "a", "kitchen", "linked"]
    assert found == [(name, tmp_path / name) for name in names]
    assert notes == [f"{tmp_path}: 3 subfolders without a log left out: above, empty, loop"]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read every folder")
def test_a_subfolder_that_may_not_be_read_is_a_site(tmp_path: Path) -> None:
    _log(tmp_path / "closed")
    (tmp_path / "closed").chmod(0)
    try:
        assert _sites(tmp_path)[0] == [("closed", tmp_path / "closed")]
    finally:
        (tmp_path / "closed").chmod(0o700)


def test_a_list_has_names_and_paths_relative_to_it(tmp_path: Path) -> None:
    file = tmp_path / "sites.txt"
    file.write_bytes(
        b"\xef\xbb\xbf# a comment\r\n\r\nberlin  logs/with a space\r\n"
        b"logs/m\xc3\xbcnchen/\n/srv/x\n"
    )
    assert _sites(file)[0] == [
        ("berlin", tmp_path / "logs/with a space"),
        ("münchen", tmp_path / "logs/münchen"),
        ("x", Path("/srv/x")),
    ]


@pytest.mark.parametrize(
    ("content", "wrong"),
    [
        (b"", "no log in it"),
        (b"# nothing\n", "no log in it"),
        (b"a x\na y\n", "lines 1 and 2 both name the site 'a'"),
        (b"x/a\ny/a\n", "lines 1 and 2 both name the site 'a'"),
        (b"a/b x\n", "line 1: 'a/b' cannot be a site's name"),
        (b"a\x1b[31m x\n", r"line 1: 'a\x1b[31m' cannot be a site's name"),
        ("a\u202eb x\n".encode(), "cannot be a site's name"),
        (b".. x\n", "line 1: '..' cannot be a site's name"),
        (b"/\n", "line 1: '' cannot be a site's name"),
        (b"a x\0y\n", "NUL"),
        (b"\xff\xfe\n", "not UTF-8 at byte 0"),
        (b"n" * 256 + b" x\n", "at most 255 bytes"),
        (b'{"detections":"' + b"A" * 20_000, '\'{"detections":"AAAA'),
        (b"a x\n" * (MAX_LIST_BYTES // 4 + 1), "larger than 16,777,216 bytes"),
    ],
)
def test_a_list_that_cannot_be_is_refused(tmp_path: Path, content: bytes, wrong: str) -> None:
    file = tmp_path / "sites.txt"
    file.write_bytes(content)
    with pytest.raises(MisuseError) as raised:
        _sites(file)
    assert wrong in str(raised.value)
    assert str(raised.value).isprintable()
    assert len(str(raised.value)) < 300


def test_one_log_no_folder_and_an_empty_folder_are_refused(tmp_path: Path) -> None:
    _log(tmp_path / "log")
    with pytest.raises(MisuseError, match="is one log; give the folder above it"):
        _sites(tmp_path / "log")
    with pytest.raises(MisuseError, match="No such file or directory; give a folder"):
        _sites(tmp_path / "absent")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MisuseError, match="no log in it"):
        _sites(tmp_path / "empty")


def _urls(names: list[str], db: str | None, vector_db: str | None = None) -> dict[str, list[str]]:
    sites = [Site(name, Path(name)) for name in names]
    with site_databases(sites, db, vector_db) as found:
        return {name: [*each.urls] for name, each in found.items()}


NAMES = st.text(st.characters(exclude_categories=("Cc", "Cs", "Zl", "Zp", "Cf", "Co", "Cn", "Zs")))


@given(NAMES.filter(lambda name: 0 < len(name.encode()) <= 59))
def test_a_name_is_the_whole_name_of_the_database_whatever_is_in_it(name: str) -> None:
    for template in (
        "postgresql://u:p%40ss@h:5433/map_{site}?sslmode=require",
        "postgresql://u:p%40ss@h:5433?dbname=map_{site}&sslmode=require",
    ):
        [url] = _urls([name], template)[name]
        assert conninfo_to_dict(url) == {
            "user": "u",
            "password": "p@ss",
            "host": "h",
            "port": "5433",
            "dbname": f"map_{name}",
            "sslmode": "require",
        }


def test_the_vectors_have_a_template_of_their_own() -> None:
    assert _urls(["a"], "postgresql://h/g_{site}", "postgresql://i/v_{site}") == {
        "a": ["postgresql://h/g_a", "postgresql://i/v_a"]
    }


@pytest.mark.parametrize(
    ("template", "wrong"),
    [
        ("postgresql://h/maps", "no {site} in it"),
        ("postgresql://h/maps?options=-csearch_path%3D{site}", "only in the database's name"),
        ("postgresql://{site}.local/maps", "not in host"),
        ("postgresql://{site}:x@h/{site}", "not in user"),
        ("postgresql://h/{site}_{robot}", "braces other than those of {site}"),
        ("mysql://h/{site}", "not a PostgreSQL URL"),
        ("postgresql://u:s/ecret@h/{site}", "not a PostgreSQL URL"),
    ],
)
def test_a_template_that_cannot_be_is_refused(template: str, wrong: str) -> None:
    with pytest.raises(MisuseError) as raised:
        _urls(["a", "b"], template)
    assert str(raised.value).startswith("--db: ")
    assert wrong in str(raised.value)
    assert "ecret" not in str(raised.value)


@pytest.mark.parametrize(
    ("names", "template", "wrong"),
    [
        (["é" * 32], "postgresql://h/{site}", "64 bytes, and PostgreSQL allows 63"),
        (["template1"], "postgresql://h/{site}", "a database of PostgreSQL's own"),
    ],
)
def test_a_name_that_no_database_can_have_is_refused(
    names: list[str], template: str, wrong: str
) -> None:
    with pytest.raises(MisuseError) as raised:
        _urls(names, template)
    assert wrong in str(raised.value)


@pytest.mark.parametrize("other", ["h", "h:5432", "H"])
def test_two_sites_never_have_one_database(other: str) -> None:
    with pytest.raises(MisuseError, match=r"sites a and x_a would both have database x_a at [hH]"):
        _urls(["a", "x_a"], "postgresql://h/x_{site}", f"postgresql://{other}/{{site}}")


def test_the_templates_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAPFOLD_DB", "postgresql://h/{site}")
    assert _urls(["a"], None) == {"a": ["postgresql://h/a"]}
    monkeypatch.setenv("MAPFOLD_DB", "postgresql://h/maps")
    with pytest.raises(MisuseError, match=r"MAPFOLD_DB: no \{site\} in it"):
        _urls(["a"], None)
