"""`mapfold log archive` and `log restore`: the same bytes back, from a folder and from a server of
S3, also where the store answers wrongly: then nothing is taken for archived."""

import contextlib
import hashlib
import json
import os
import runpy
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from eventsrc.base.errors import (
    ArchiveError,
    LogError,
    MapfoldError,
    MisuseError,
    NoSuchObject,
    NotALog,
)
from eventsrc.base.object_store import ObjectStore
from eventsrc.envelope.model import Offset
from eventsrc.log import LogReader, LogWriter, verify_log
from eventsrc.log.archive import Archive, Archived, ManifestEntry, archive_log
from eventsrc.log.archive_place import archive_place, note_archive_place, place_locked
from eventsrc.log.away import archived_log, restore_log, retain_log
from eventsrc.log.redact import Redactor
from eventsrc.log.verify import verify_archive
from projections.fold.semantic_map import SemanticMap
from projections.surfaces.cli import redact_command
from tests.integration.test_kept_maps import nothing_is_folded
from tests.integration.test_progress import reports_of
from tests.property.test_timeline_cache import kept_early
from tests.support.buckets import BUCKET, Answer, Fault, Proxy, proxy_of, s3_environment, s3_server
from tests.support.commands import Commands
from tests.support.envelopes import envelope, payload
from tests.support.fixtures_log import KEY, flip, read_log
from tests.support.logs import SAMPLE
from tests.support.shared_data import ROOT

RECORDED = 60
SEGMENTS = 4


def recorded(log: Path, first: int = 0, count: int = RECORDED) -> Path:
    """A log of `SEGMENTS` segments, or more of the same log."""
    with LogWriter(log, rotate_events=RECORDED // SEGMENTS) as writer:
        for number in range(first, first + count):
            writer.append(KEY, payload(envelope(number)))
            writer.sync()
    return log


def bytes_of(log: Path) -> dict[str, str]:
    """Name and hash of each segment."""
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(log.iterdir())
        if ".mcap" in path.name
    }


def folder_url(path: Path) -> str:
    """The URL of an archive in a folder."""
    return f"file://{path.as_posix()}"


def archived(log: Path, url: str) -> Archived:
    """Archive a log, in which nothing is to be said."""
    return archive_log(log, ObjectStore(url, make=True), note=pytest.fail)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A closed log."""
    return recorded(tmp_path / "log")


@pytest.fixture
def url(tmp_path: Path) -> str:
    """Where it is archived."""
    return folder_url(tmp_path / "an archive")


def test_the_same_bytes_come_back(log: Path, url: str, tmp_path: Path) -> None:
    stages = {each[0] for each in reports_of(lambda: archived(log, url))}
    assert "archiving" in stages
    made = archived(log, folder_url(tmp_path / "another"))
    assert (made.added_segments, made.events, made.not_sealed) == (SEGMENTS, RECORDED, False)
    again = archived(log, url)
    assert (again.added_segments, again.added_bytes, again.segments) == (0, 0, SEGMENTS)
    back = tmp_path / "back"
    restored = restore_log(Archive(ObjectStore(url)), back)
    assert (restored.fetched_segments, restored.events) == (SEGMENTS, RECORDED)
    assert bytes_of(back) == bytes_of(log)
    assert verify_log(back).findings == ()
    recorded(back, RECORDED, 15)  # it is a log like any other
    recorded(log, RECORDED, 15)
    assert archived(log, url).added_segments == 1
    assert verify_archive(ObjectStore(url)).events == RECORDED + 15


def test_commands_archive_verify_and_restore(log: Path, url: str, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    said = mapfold("log", "archive", "log", url, "--json").json
    assert (said["events"], said["added_segments"]) == (RECORDED, SEGMENTS)
    assert "all good" in mapfold("log", "archive", "nowhere", url, "--verify").err
    assert mapfold("log", "archive", "log", url, "--verify", "--json").json["findings"] == []
    mapfold("log", "restore", url, "back")
    assert bytes_of(tmp_path / "back") == bytes_of(log)
    assert "fetched 0 segments" in mapfold("log", "restore", url, "back").err
    assert "no archive" in mapfold("log", "restore", folder_url(tmp_path), "x", code=1).err
    assert "no such folder" in mapfold("log", "restore", url + "x", "x", code=1).err
    assert not (tmp_path / "x").exists()
    secret = mapfold("log", "archive", "log", "s3://me:hunter2@bucket/x", code=2).err
    assert "hunter2" not in secret
    assert "credentials" in secret


def test_a_restored_log_has_its_fold(log: Path, url: str, tmp_path: Path) -> None:
    from projections.surfaces.cli.archive_command import archive, restore
    from projections.surfaces.cli.folded_log import CachedLog
    from projections.surfaces.cli.maps import state

    with kept_early():
        archive(log, url)
        restore(url, tmp_path / "back")
        with patch.object(SemanticMap, "fold", nothing_is_folded):
            state(source=CachedLog(log=tmp_path / "back"))
        recorded(log, RECORDED, 15)
        archive(log, url)
        kept = Archive(ObjectStore(url)).kept_files()
    assert kept
    assert all(str(RECORDED + 15) in name for name in kept if name.endswith(".fold"))


def test_another_log_is_never_written_over(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    archive = Archive(ObjectStore(url))
    other = recorded(tmp_path / "other")
    longer = tmp_path / "longer"
    restore_log(archive, longer)
    recorded(longer, RECORDED, 3)
    document = tmp_path / "letters"
    document.mkdir()
    (document / "letter").write_text("dear")
    assert restore_log(archive, longer).fetched_segments == 0  # it has all
    assert len(read_log(longer)) == RECORDED + 3
    for target in (other, document):
        before = sorted(path.name for path in target.iterdir())
        with pytest.raises((LogError, NotALog)):
            restore_log(archive, target)
        assert sorted(path.name for path in target.iterdir()) == before
    with pytest.raises(ArchiveError, match="choose another URL"):
        archived(other, url)
    with LogWriter(log):  # what is being recorded is left alone, too
        assert restore_log(archive, log).fetched_segments == 0


def test_damage_is_not_archived(log: Path, url: str) -> None:
    path = sorted(log.glob("*.mcap"))[2]
    flip(path, 900)
    with pytest.raises(LogError, match="log recover"):
        archived(log, url)
    assert len(Archive(ObjectStore(url)).entries()) == 2


def test_a_damaged_archive_is_reported(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    store = ObjectStore(url)
    one, other = sorted((tmp_path / "an archive" / "segments").iterdir())[1:3]
    flip(one, 800)
    found = verify_archive(store).findings
    assert [each.kind for each in found] == ["crc"]
    with pytest.raises(ArchiveError, match="the store gives"):
        restore_log(Archive(store), tmp_path / "back")
    with pytest.raises(LogError, match="were sealed and are not there"):
        verify_or_write(tmp_path / "back")
    flip(one, 800)
    other.unlink()
    assert [each.kind for each in verify_archive(store).findings] == ["gap"]
    entry = sorted((tmp_path / "an archive" / "manifest").iterdir())[1]
    entry.unlink()
    assert [each.kind for each in verify_archive(store).findings] == ["gap", "gap"]
    assert one.name in verify_archive(store).unnamed[0]
    with pytest.raises(ArchiveError, match="not archived"):
        Archive(store).entries()


def verify_or_write(log: Path) -> None:
    """Open a log for writing."""
    LogWriter(log).close()


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    """A server of S3."""
    with s3_server() as address:
        yield address


@pytest.fixture
def proxy(server: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Proxy]:
    """A proxy before it, which this process uses; what fails is tried once more."""
    with proxy_of(server) as made:
        for name, value in s3_environment(made.address).items():
            monkeypatch.setenv(name, value)
        quick = {"max_retries": 1}
        with patch("eventsrc.base.object_store._RETRIES", quick):
            yield made


@pytest.mark.seconds
def test_a_bucket_keeps_a_log(log: Path, proxy: Proxy, tmp_path: Path) -> None:
    url = f"s3://{BUCKET}/{tmp_path.name}/robot-7"
    mapfold = Commands.in_folder(tmp_path, **s3_environment(proxy.address))
    mapfold("log", "archive", "log", url)
    assert mapfold("log", "archive", "log", url, "--verify", "--json").json["findings"] == []
    mapfold("log", "restore", url, "back")
    assert bytes_of(tmp_path / "back") == bytes_of(log)
    puts = [path for method, path in proxy.requests if method == "PUT"]
    assert len(puts) == len(set(puts))  # each object once
    gone = mapfold("log", "restore", "s3://no-such-bucket/x", "x", code=1).err
    assert "no archive of a log" in gone


@pytest.mark.seconds
@pytest.mark.parametrize("place", ["folder", "bucket"])
def test_nothing_is_put_over_an_object(place: str, url: str, proxy: Proxy, tmp_path: Path) -> None:
    store = ObjectStore(url if place == "folder" else f"s3://{BUCKET}/{tmp_path.name}", make=True)
    assert store.put_new("a/b", b"first")
    assert not store.put_new("a/b", b"second")
    assert store.read("a/b") == b"first"
    assert store.sizes("a/") == {"a/b": 5}
    store.delete("a/b")
    store.delete("a/b")
    with pytest.raises(NoSuchObject, match="no such object"):
        store.read("a/b")


def says_500(_method: str, _path: str, answer: Answer) -> Answer:
    return replace(answer, status=500, body=b"busy", length=4)


def refuses(_method: str, _path: str, answer: Answer) -> Answer:
    body = b"<Error><Code>ExpiredToken</Code><Message>has expired</Message></Error>"
    return replace(answer, status=403, body=body, length=len(body))


def on_segments(fault: Callable[[bytes], bytes], *, shorten: bool = False) -> Fault:
    """A fault of the bodies of segments that are read."""

    def changed(method: str, path: str, answer: Answer) -> Answer:
        if method != "GET" or "/segments/" not in path:
            return answer
        body = fault(answer.body)
        return replace(answer, body=body, length=answer.length if shorten else len(body))

    return changed


FAULTS: dict[str, tuple[Fault, str]] = {
    "500s": (says_500, "500"),
    "credentials": (refuses, "refuses access"),
    "wrong bytes": (on_segments(lambda body: body[:-9] + b"!" + body[-8:]), "the store gives"),
    "another object": (on_segments(lambda body: b"hello"), "the store gives"),
    "cut": (on_segments(lambda body: body[:-100], shorten=True), "nothing is lost here"),
}


@pytest.mark.seconds
@pytest.mark.parametrize("name", FAULTS)
def test_a_store_that_answers_wrongly(
    name: str, log: Path, proxy: Proxy, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault, told = FAULTS[name]
    url = f"s3://{BUCKET}/{tmp_path.name}"
    before = bytes_of(log)
    proxy.fault = fault
    with pytest.raises(ArchiveError, match=told) as raised:
        archived(log, url)
    assert "\n" not in str(raised.value)
    assert os.environ["AWS_SECRET_ACCESS_KEY"] not in str(raised.value)
    assert bytes_of(log) == before
    proxy.fault = Proxy().fault
    assert archived(log, url).events == RECORDED  # it goes on
    proxy.fault = fault
    with pytest.raises(ArchiveError, match=told):
        restore_log(Archive(ObjectStore(url)), tmp_path / "back")
    proxy.fault = Proxy().fault
    restore_log(Archive(ObjectStore(url)), tmp_path / "back")
    assert bytes_of(tmp_path / "back") == before


def test_forty_lines_verify_an_archive(log: Path, url: str, tmp_path: Path) -> None:
    script = ROOT / "docs" / "verify_archive.py"
    assert len(script.read_text().splitlines()) <= 45
    verify = runpy.run_path(str(script))["verify"]
    archived(log, url)
    folder = tmp_path / "an archive"
    assert verify(folder) == RECORDED
    entry = sorted((folder / "manifest").iterdir())[2]
    for old, new, told in (
        ('"following": 48', '"following": 47', "number of events"),
        ('"sha256": "', '"sha256": "0', "SHA-256"),
    ):
        right = entry.read_text()
        entry.write_text(right.replace(old, new, 1))
        with pytest.raises(SystemExit, match=told):
            verify(folder)
        entry.write_text(right)


def test_what_is_no_url_of_an_archive() -> None:
    for text in ("/a/path", "ftp://x/y", "file://x/y", "s3://b/x?token=abc"):
        with pytest.raises((MisuseError, MapfoldError)) as raised:
            ObjectStore(text)
        assert "abc" not in str(raised.value)


def test_an_archive_is_read_by_its_url(log: Path, url: str, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    mapfold("log", "archive", log, url)
    for words in (("state", "LOG", "--digest"), ("log", "cat", "LOG", "--json"), ("merges", "LOG")):
        of_log, of_url = ([str(at) if w == "LOG" else w for w in words] for at in (log, url))
        assert mapfold(*of_url).out == mapfold(*of_log).out
    assert mapfold("log", "verify", url, "--json").json["findings"] == []
    info = mapfold("log", "info", url, "--json").json
    assert [each["away"] for each in info["segments"]] == [True] * SEGMENTS
    recorded(log, RECORDED, 15)
    mapfold("log", "archive", log, url)
    assert mapfold("log", "info", url, "--json").json["events"] == RECORDED + 15
    (tmp_path / "x.jsonl").write_bytes(payload(envelope(1)))
    for words in (
        ("edit", url, "name-place", "p0", "hall"),
        ("import", url, "x.jsonl"),
        ("log", "recover", url),
        ("log", "archive", url, folder_url(tmp_path / "other")),
        ("log", "retain", url, "--keep", "1d"),
        ("log", "redact", url, "--run", "run-a", "--reason", "a test"),
    ):
        told = mapfold(*words, code=1).err
        assert f"{url} is an archive, which is only read here" in told
        assert f"`mapfold log restore '{url}' LOG`" in told  # quoted, as its name has a space
    assert "restore into a folder" in mapfold("log", "restore", url, url, code=2).err
    assert "no archive" in mapfold("state", folder_url(tmp_path), code=1).err


@pytest.mark.seconds
def test_no_url_leads_out_of_the_folder_of_archives(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    victim = tmp_path / "an archive"
    home = tmp_path / "a" / "b" / "c" / "home"
    before = {each: each.read_bytes() for each in victim.rglob("*") if each.is_file()}
    there = archived_log("file:///" + "../" * 9 + str(victim).lstrip("/"), home)
    assert there.parent == home / "archives"
    assert {each: each.read_bytes() for each in victim.rglob("*") if each.is_file()} == before
    assert archived_log(f"{url}/../an archive", home).parent == home / "archives"


def test_reading_takes_what_it_needs_from_the_archive(proxy: Proxy, tmp_path: Path) -> None:
    log = shutil.copytree(SAMPLE, tmp_path / "log")
    url = f"s3://{BUCKET}/{tmp_path.name}"
    archived(log, url)
    size = sum(path.stat().st_size for path in log.glob("*.mcap"))
    before = proxy.sent
    away = archived_log(url, tmp_path / "home")
    with LogReader(away) as reader:
        indexes = proxy.sent - before
        list(reader.read(Offset(10), Offset(11)))
    assert indexes < size // 2
    proxy.fault = says_500
    with LogReader(away) as reader, pytest.raises(ArchiveError, match="500"):
        list(reader.read())
    proxy.fault = Proxy().fault
    with LogReader(away) as reader, LogReader(log) as here:
        assert list(reader.read()) == list(here.read())
    whole = proxy.sent
    with LogReader(archived_log(url, tmp_path / "home")) as reader:
        list(reader.read())
    assert proxy.sent - whole < 4_000  # the manifest's names; the rest is here


def test_retained_segments_come_back(log: Path, url: str, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    whole, digest = bytes_of(log), mapfold("state", log, "--digest").out
    assert "not archived" in mapfold("log", "retain", log, "--keep-bytes", "0", code=1).err
    mapfold("log", "archive", log, url)
    assert "0 segments" in mapfold("log", "retain", log, "--keep", "30d").err
    said = mapfold("log", "retain", log, "--keep-bytes", "0", "--json").json
    assert (said["away_segments"], said["segments"]) == (SEGMENTS - 1, 1)
    assert len(list(log.glob("*.mcap"))) == 1
    assert mapfold("state", log, "--digest", "--no-cache").out == digest
    assert "archive only" in mapfold("log", "info", log).out
    assert mapfold("log", "verify", log, "--json").json["findings"] == []
    recorded(log, RECORDED, 15)  # a recorder goes on
    mapfold("log", "archive", log, url)
    assert "in the archive only" in mapfold("log", "recover", log, code=1).err
    with LogWriter(log):  # beside a recorder
        mapfold("log", "restore", url, log)
    assert bytes_of(log).items() >= whole.items()
    assert not list(log.glob("*.away"))


def test_nothing_goes_that_the_archive_has_not(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    one = sorted((tmp_path / "an archive" / "segments").iterdir())[1]
    flip(one, 700)
    with pytest.raises(ArchiveError, match="the store gives"):
        retain_log(log, keep_bytes=0)
    assert len(list(log.glob("*.mcap"))) == SEGMENTS - 1
    flip(one, 700)
    flip(min(log.glob("*.mcap")), 700)
    with pytest.raises(ArchiveError, match="not archived as it is here"):
        retain_log(log, keep_bytes=0)
    (tmp_path / "an archive").rename(tmp_path / "unplugged")
    with pytest.raises(NoSuchObject, match="no such folder"):
        retain_log(log, keep_bytes=0)


def test_a_segment_redacted_while_its_archived_one_is_read_stays(
    log: Path, url: str, tmp_path: Path
) -> None:
    """What was erased would come back from the archive."""
    archived(log, url)
    real = Archive.check

    def redacts(archive: Archive, entry: ManifestEntry) -> None:
        real(archive, entry)
        Commands.in_folder(tmp_path)("log", "redact", log, "--run", "run-a", "--reason", "a test")

    with patch.object(Archive, "check", redacts), pytest.raises(ArchiveError, match="as it is her"):
        retain_log(log, keep_bytes=0)
    assert list(log.glob("*.away")) == []
    assert verify_log(log).findings == ()


def test_a_part_of_a_log_is_restored(log: Path, url: str, tmp_path: Path) -> None:
    mapfold = Commands.in_folder(tmp_path)
    mapfold("log", "archive", log, url)
    mapfold("log", "restore", url, "early", "--at", "20")
    assert mapfold("log", "info", "early", "--json").json["events"] == 32
    mapfold("log", "restore", url, "late", "--from", "run-a:40")
    assert len(list((tmp_path / "late").glob("*.mcap"))) == 2
    assert mapfold("state", "late", "--digest").out == mapfold("state", log, "--digest").out
    assert (
        "after --to"
        in mapfold("log", "restore", url, "x", "--from", "30", "--to", "20", code=2).err
    )
    assert bytes_of(tmp_path / "early").items() <= bytes_of(log).items()


def test_fetched_chunks_take_no_more_than_allowed(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    away = archived_log(url, tmp_path / "home")
    with patch("eventsrc.log.sealed_segment.FETCHED_BYTES", 0), LogReader(away) as reader:
        assert len(list(reader.read())) == RECORDED
    with LogReader(away) as reader:
        assert len(list(reader.read())) == RECORDED


def test_a_redacted_segment_takes_the_place_of_the_archived_one(
    log: Path, url: str, tmp_path: Path
) -> None:
    mapfold = Commands.in_folder(tmp_path)
    mapfold("log", "archive", log, url)
    store, before = ObjectStore(url), Archive(ObjectStore(url)).entries()
    archived_log(url, tmp_path / "home")
    mapfold("log", "redact", log, "--run", "run-a", "--reason", "a test")
    assert archived(log, url).replaced_segments == SEGMENTS
    there = store.sizes("segments/")
    assert not {each.object for each in before} & set(there)
    assert verify_archive(store).findings == ()
    assert archived(log, url).replaced_segments == 0
    with LogReader(archived_log(url, tmp_path / "home")) as reader, LogReader(log) as here:
        assert list(reader.read()) == list(here.read())
    mapfold("log", "retain", log, "--keep-bytes", "0")
    with Redactor(log) as redactor, pytest.raises(LogError, match="in the archive only"):
        redactor.stage(lambda _: None, b"salt")


@pytest.mark.parametrize("call", ["put_new", "replace", "delete"])
def test_an_archiver_killed_while_it_replaces_leaves_nothing_redacted(
    call: str, log: Path, url: str, tmp_path: Path
) -> None:
    mapfold = Commands.in_folder(tmp_path)
    mapfold("log", "archive", log, url)
    before = {each.object for each in Archive(ObjectStore(url)).entries()}
    mapfold("log", "redact", log, "--run", "run-a", "--reason", "a test")
    real = getattr(ObjectStore, call)
    for calls in range(4):
        done = iter([*range(calls)])

        def killed(*given: Any, done: Iterator[int] = done, **more: Any) -> Any:
            if next(done, None) is None:
                raise KeyboardInterrupt
            return real(*given, **more)

        with patch.object(ObjectStore, call, killed), contextlib.suppress(KeyboardInterrupt):
            archived(log, url)
    archived(log, url)
    assert not before & ObjectStore(url).sizes("segments/").keys()
    assert verify_archive(ObjectStore(url)).unnamed == ()


def test_segments_that_go_at_once_are_all_noted(log: Path) -> None:
    def note(first: int) -> None:
        for number in range(first, first + 8):
            with place_locked(log):
                note_archive_place(log, "file:///a", {str(number): "x"})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(note, range(0, 32, 8)))
    place = archive_place(log)
    assert place is not None
    assert set(place.objects) == {str(number) for number in range(32)}
    with place_locked(log):
        note_archive_place(log, "file:///other")
    assert archive_place(log) == place  # segments are away there


@pytest.mark.parametrize("tidied_by", ["restore", "retain", "redact", "recorder"])
def test_a_restore_killed_before_its_last_step_leaves_no_stand_in(
    tidied_by: str, log: Path, url: str, tmp_path: Path
) -> None:
    archived(log, url)
    retain_log(log, keep_bytes=0)
    with LogReader(log) as reader:
        list(reader.read())  # fetches chunks into what stands for them
    gone = patch("eventsrc.log.archive_place.delete_durably", side_effect=KeyboardInterrupt)
    with gone, pytest.raises(KeyboardInterrupt):
        restore_log(Archive(ObjectStore(url)), log)
    assert len(list(log.glob("*.away"))) == SEGMENTS - 1
    assert len(list(log.glob("*.mcap"))) == SEGMENTS
    if tidied_by == "restore":
        restore_log(Archive(ObjectStore(url)), log)
    elif tidied_by == "retain":
        retain_log(log, keep_bytes=10**9)
    elif tidied_by == "recorder":
        verify_or_write(log)
    else:
        Commands.in_folder(tmp_path)("log", "redact", log, "--run", "run-a", "--reason", "a test")
    assert list(log.glob("*.away")) == []
    assert verify_log(log).findings == ()


def test_what_is_redacted_while_it_is_restored_stays_so(log: Path, url: str) -> None:
    """By two who restore it at once; their half-made files are not one."""
    archived(log, url)
    retain_log(log, keep_bytes=0)
    real, left = Archive.write_checked, [Archive(ObjectStore(url))]

    def after_another(*given: Any) -> None:
        if left:
            restore_log(left.pop(), log)
            redact_command.redact(log, run=["run-a"], reason="a test")
        real(*given)

    other = pytest.raises(LogError, match="differs from the archived one")
    with patch.object(Archive, "write_checked", after_another), other:
        restore_log(Archive(ObjectStore(url)), log)
    assert verify_log(log).findings == ()
    assert not [each for each in read_log(log) if each.key == KEY]
    assert not list(log.glob("*.sealing"))


def test_a_false_place_of_an_index_is_found(log: Path, url: str, tmp_path: Path) -> None:
    archived(log, url)
    entry = sorted((tmp_path / "an archive" / "manifest").iterdir())[1]
    right = json.loads(entry.read_text())
    for wrong in (0, right["index_at"] - 1, right["index_at"] + 1, right["size"] + 9):
        entry.write_text(json.dumps(right | {"index_at": wrong}))
        (found,) = verify_archive(ObjectStore(url)).findings
        assert found.kind == "crc"
        with pytest.raises(ArchiveError):
            archived_log(url, tmp_path / f"home{wrong}")


def test_commands_that_begin_to_read_an_archive_at_once(
    log: Path, url: str, tmp_path: Path
) -> None:
    mapfold = Commands.in_folder(tmp_path)
    mapfold("log", "archive", log, url)
    archived_log(url, tmp_path / "home")
    mapfold("log", "redact", log, "--run", "run-a", "--reason", "a test")
    archived(log, url)
    with ThreadPoolExecutor(6) as pool:
        (away,) = set(pool.map(lambda _: archived_log(url, tmp_path / "home"), range(12)))
    with LogReader(away) as reader, LogReader(log) as here:
        assert list(reader.read()) == list(here.read())
