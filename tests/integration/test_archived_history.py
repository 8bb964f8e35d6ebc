"""The kept history of an archived log: read by ranges, of which few are needed, and folded again
where it is damaged or gone."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
import zstandard

from eventsrc.base.errors import ArchiveError
from eventsrc.base.object_store import ObjectStore
from eventsrc.log import LogReader, LogWriter, cache_folder
from eventsrc.log.archive import Archive
from eventsrc.log.archived_history import archive_kept, stand_for_kept
from eventsrc.log.away import archived_log, restore_log
from projections.fold.semantic_map import SemanticMap
from projections.fold.settings import Settings
from projections.map.digest import map_digest
from projections.map.parsing import read_corrections
from projections.map.view import MapView
from projections.store.history_recorder import map_after
from projections.surfaces.cli.archive_command import archive
from tests.integration.test_archive import folder_url
from tests.integration.test_kept_maps import nothing_is_folded
from tests.property.test_timeline_cache import kept_early
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY
from tests.support.logs import SAMPLE

_SHORT = patch("eventsrc.log.archived_history._AT_ONCE", 0)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the sample log, its history in short stripes, and their archive."""
    folder = tmp_path_factory.mktemp("made")
    with kept_early(40):
        archive(shutil.copytree(SAMPLE, folder / "log"), folder_url(folder / "archive"))
    return folder


@pytest.fixture
def url(made: Path, tmp_path: Path) -> Iterator[str]:
    """A copy of that archive, with the log beside it."""
    shutil.copytree(made, tmp_path, dirs_exist_ok=True)
    with kept_early(40):
        yield folder_url(tmp_path / "archive")


def answer(log: Path) -> str:
    """The digest of a log's map, by its history; nothing may be said."""
    return map_digest(map_of(log, pytest.fail))


def map_of(log: Path, note: Callable[[str], Any]) -> MapView:
    """The map of a log, by its history, under the settings of the log."""
    with LogReader(log) as reader:
        corrections = read_corrections(reader)
        settings = corrections.settings or Settings()
        return map_after(reader, settings, corrections=corrections, note=note)


def fetched(url: str, home: Path, *, whole: bool) -> int:
    """How many bytes of the archived history an answer takes: of the number of places, or of the
    whole map."""
    total, real = 0, ObjectStore.part

    def part(self: ObjectStore, name: str, start: int, end: int) -> bytes:
        nonlocal total
        total += (end - start) * name.startswith("kept/")
        return real(self, name, start, end)

    with (
        patch.object(ObjectStore, "part", part),
        patch.object(SemanticMap, "fold", nothing_is_folded),
    ):
        view = map_of(archived_log(url, home), pytest.fail)
        assert view.places
        if whole:
            map_digest(view)
    return total


def test_a_question_takes_the_columns_that_it_needs(url: str, tmp_path: Path) -> None:
    sizes = Archive(ObjectStore(url)).kept_files()
    (part,) = (size for name, size in sizes.items() if name.endswith(".npz.packed"))
    (local,) = cache_folder(tmp_path / "log").glob("*.npz")
    assert part < local.stat().st_size // 2
    with _SHORT:
        few = fetched(url, tmp_path / "one", whole=False)
        many = fetched(url, tmp_path / "other", whole=True)
        assert 0 < few < many - part // 8
        assert fetched(url, tmp_path / "other", whole=True) == 0  # it is here now
    assert answer(archived_log(url, tmp_path / "other")) == answer(tmp_path / "log")


def test_the_same_files_are_restored(url: str, tmp_path: Path) -> None:
    restore_log(Archive(ObjectStore(url)), tmp_path / "back")
    there = {p.name: p.read_bytes() for p in cache_folder(tmp_path / "log").iterdir()}
    here = {p.name: p.read_bytes() for p in cache_folder(tmp_path / "back").iterdir()}
    assert here
    assert here.items() <= there.items()


def packed(tmp_path: Path) -> list[Path]:
    """The archived files of the history."""
    return sorted((tmp_path / "archive" / "kept").iterdir())


@pytest.mark.parametrize("at", [None, -40, -3], ids=["span", "index", "end"])
def test_a_damaged_history_is_folded_again(at: int | None, url: str, tmp_path: Path) -> None:
    for path in packed(tmp_path):
        data = bytearray(path.read_bytes())
        data[len(data) // 3 if at is None else at] ^= 1
        path.write_bytes(data)
    log, said = archived_log(url, tmp_path / "home"), list[str]()
    found = map_digest(map_of(log, said.append))
    assert found == answer(tmp_path / "log")
    assert any("is folded again" in each for each in said) == (at is None)
    restore_log(Archive(ObjectStore(url)), tmp_path / "back")  # without it
    assert answer(tmp_path / "back") == found


def _sized(size: int, width: int) -> bytes:
    """An object of one span that says so of the file and its numbers."""
    index = {"size": size, "starts": [0], "lengths": [1], "number_bytes": [width]}
    return b"x" + _ended(zstandard.compress(json.dumps(index).encode()))


def _ended(index: bytes) -> bytes:
    return index + len(index).to_bytes(8, "little") + b"mapfold1"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        _sized(10**17, 1),
        _sized(2**70, 1),
        _sized(9, 2**70),
        _ended(b"\x28\xb5\x2f\xfd\xe0" + (2**50).to_bytes(8, "little") + b"\x01\x00\x00"),
    ],
    ids=["empty", "file", "long", "number", "index"],
)
def test_what_says_that_it_takes_terabytes_is_left_out(
    content: bytes, url: str, tmp_path: Path
) -> None:
    for path in packed(tmp_path):
        path.write_bytes(content)
    log = archived_log(url, tmp_path / "home")
    stand_for_kept(log)
    assert not list(cache_folder(log).iterdir())
    restore_log(Archive(ObjectStore(url)), tmp_path / "back")
    assert not list(cache_folder(tmp_path / "back").glob("*.npz"))


def test_what_is_cut_off_after_it_was_listed_is_folded_again(url: str, tmp_path: Path) -> None:
    stand_for_kept(archived_log(url, tmp_path / "home"))
    for path in packed(tmp_path):
        path.write_bytes(path.read_bytes()[:100])
    log = archived_log(url, tmp_path / "home")
    assert map_digest(map_of(log, str)) == answer(tmp_path / "log")


def test_a_history_that_the_archiver_replaced_is_taken_anew(url: str, tmp_path: Path) -> None:
    log = archived_log(url, tmp_path / "home")
    answer(log)
    before = {path.name for path in packed(tmp_path)}
    with LogWriter(tmp_path / "log") as writer:
        writer.append(KEY, payload(envelope(70_000)))
    archive(tmp_path / "log", url)
    assert answer(archived_log(url, tmp_path / "home")) == answer(tmp_path / "log")
    gone = before - {path.name for path in packed(tmp_path)}
    assert gone
    left = {path.name for path in cache_folder(log).iterdir()}
    assert not {name.replace(".packed", ".away") for name in gone} & left
    archive_kept(tmp_path / "log", ObjectStore(url), {})
    assert packed(tmp_path) == []


def test_a_store_that_does_not_answer_is_no_damage(url: str, tmp_path: Path) -> None:
    log = archived_log(url, tmp_path / "home")

    def fails(*_: Any) -> bytes:
        raise ArchiveError("no route")

    failing = patch.object(ObjectStore, "part", fails)
    with failing, pytest.raises(ArchiveError, match="no route"):
        map_of(log, pytest.fail)
    assert answer(archived_log(url, tmp_path / "home")) == answer(tmp_path / "log")
