"""Where the caches of a log are, whatever path names the log, and who may read them."""

import os
import shutil
from pathlib import Path

import pytest

from eventsrc.log import cache_folder, cache_sizes, make_cache_folder
from projections.history import LogTimeline
from tests.property.test_timeline_cache import kept_early
from tests.support.envelopes import envelope
from tests.support.walks import write_log


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A log, with a folder in it that is the working directory; another name links to the log."""
    log = write_log(tmp_path / "log", [envelope(n, 0.1 * n, 0.0) for n in range(9)])
    (log / "within").mkdir()
    (tmp_path / "link").symlink_to(log)
    monkeypatch.chdir(log / "within")
    return log


def test_every_path_of_a_log_has_its_caches_beside_it(log: Path) -> None:
    for path in (log, Path(".."), Path("../."), Path("../../log"), Path("../within/..")):
        assert cache_folder(path).resolve() == log.with_name("log.history"), path
    os.chdir("..")
    assert cache_folder(Path()).resolve() == log.with_name("log.history")
    assert cache_folder(log.with_name("link")) == log.with_name("link.history")
    assert cache_folder(Path("/")) == Path("/.history")


@pytest.mark.parametrize("named", [".", ".."])
def test_a_log_named_by_dots_is_answered_and_kept(log: Path, named: str) -> None:
    if named == ".":
        os.chdir("..")
    with kept_early(), LogTimeline(Path(named)) as timeline:
        assert timeline.at(9).counts()["keyframes"] == 9
    assert {path.suffix for path in log.with_name("log.history").iterdir()} == {".fold", ".npz"}
    assert [folder.resolve() for folder, _ in cache_sizes(Path(named))] == [
        log.with_name("log.history")
    ]


@pytest.mark.parametrize(("of_log", "of_cache"), [(0o750, 0o750), (0o700, 0o700), (0o555, 0o755)])
def test_who_may_not_read_the_log_may_not_read_its_caches(
    log: Path, of_log: int, of_cache: int
) -> None:
    was = os.umask(0o022)
    try:
        log.chmod(of_log)
        assert make_cache_folder(log).stat().st_mode & 0o777 == of_cache
    finally:
        os.umask(was)
        log.chmod(0o755)


def test_sizes_of_caches_that_change_or_cannot_be_read(log: Path) -> None:
    assert cache_sizes(log) == []
    make_cache_folder(log)
    (log.with_name("log.history") / "a").write_bytes(b"1234")
    (log.with_name("log.history") / "gone").symlink_to("nowhere")
    assert cache_sizes(log) == [(log.with_name("log.history"), 4 + len("nowhere"))]
    shutil.rmtree(log.with_name("log.history"))
    log.with_name("log.history").write_text("no folder")
    assert cache_sizes(log) == []
