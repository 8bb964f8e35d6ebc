"""Logs of which segments are away, in an archive only (`eventsrc.log.archive`): let segments go,
bring them back, and read a log that is here with none of them.

Restoring writes `.sealed.json` first, with the end that the log will have. So a log that is not
restored to its end is one with missing segments: readers and recorders refuse it by themselves.
"""

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final, NamedTuple

import msgspec

from eventsrc.base.errors import ArchiveError, LogDamaged, LogError, NotALog
from eventsrc.base.machine import system_clock
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.base.text import advised
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from .archive import READERS, SEGMENTS, Archive, ManifestEntry
from .archive_place import (
    archive_place,
    delete_stand_ins,
    note_archive_place,
    place_locked,
    refuse_away,
    stand_in,
)
from .archived_history import restore_kept
from .durable_files import (
    delete_durably,
    make_directory_durably,
    replace_durably,
    sync_file,
    unlink_quietly,
)
from .lock import WriterLock, file_locked
from .log_identity import cache_folder, write_cache_file
from .seal import file_sha256
from .sealed_end import SealedEnd, sealed_end, segments_of, write_sealed_end
from .sealed_segment import SealedFile


@dataclass(frozen=True, slots=True)
class Restored:
    """What `restore_log` did: the ``fetched`` segments and bytes, and what the log has now."""

    log_id: str
    fetched_segments: int
    fetched_bytes: int
    segments: int
    events: int


def restore_log(
    archive: Archive,
    log: Path,
    *,
    start: Offset = FIRST_OFFSET,
    until: Offset | None = None,
) -> Restored:
    """Bring back the segments with the events from ``start`` to before ``until`` (None: the end),
    and the kept history; earlier segments are away. A log that was restored in part is restored
    further, and one that has segments away gets them. Raises ArchiveError, and LogError if ``log``
    is another log or has anything else that the archive has not."""
    entries = archive.entries()
    if not entries:
        raise ArchiveError(f"{archive.store.url} has no segment yet")
    wanted = [each for each in entries if until is None or each.base < max(until, 1)]
    here = [each for each in wanted if each.following > start] or wanted[-1:]
    if log.is_dir():
        delete_stand_ins(log)  # a restore was killed
    if _has_all(log, archive, wanted):
        fetched = _bring_back(log, archive, here)
        end = sealed_end(log)
        events = wanted[-1].following if end is None else end.following
        there = len(names.list_growing(log))
        return Restored(archive.log_id, len(fetched), sum(e.size for e in fetched), there, events)
    _check_target(log, archive, wanted)
    make_directory_durably(log)
    with WriterLock(log, system_clock):
        for path in names.leftovers(log):  # of a restore that was killed
            unlink_quietly(path)
        _check_target(log, archive, wanted)
        last = wanted[-1]
        end = SealedEnd(archive.log_id, Offset(last.base), Offset(last.following))
        if sealed_end(log) != end:
            write_sealed_end(log, end)
        _make_away(log, archive, wanted[: len(wanted) - len(here)])
        fetched = _fetch_segments(log, archive, here)
    restore_kept(log, archive, Offset(last.following))
    return Restored(
        archive.log_id, len(fetched), sum(e.size for e in fetched), len(wanted), last.following
    )


def _has_all(log: Path, archive: Archive, wanted: list[ManifestEntry]) -> bool:
    """Whether a log that is archived there has all these segments, here or away."""
    place = archive_place(log) if log.is_dir() else None
    if place is None or place.url != archive.store.url:
        return False
    there, end = {each.base for each in names.list_growing(log)}, sealed_end(log)
    return end is not None and end.log_id == archive.log_id and there >= {e.base for e in wanted}


def _bring_back(log: Path, archive: Archive, wanted: list[ManifestEntry]) -> list[ManifestEntry]:
    away = {each.base for each in names.list_growing(log) if each.away}
    try:
        return _fetch_segments(log, archive, [each for each in wanted if each.base in away])
    finally:
        delete_stand_ins(log)


def _away_path(log: Path, entry: ManifestEntry) -> Path:
    return names.segment_path(log, Offset(entry.base), names.AWAY)


def _make_away(log: Path, archive: Archive, entries: Sequence[ManifestEntry]) -> None:
    """Make files that stand for archived segments which are not here. Where they are is noted
    first."""
    with place_locked(log):
        away = {_away_path(log, each).name: each.object for each in entries}
        note_archive_place(log, archive.store.url, away)

    def make(entry: ManifestEntry) -> None:
        stand_in_for(archive, entry, _away_path(log, entry))

    missing = [each for each in entries if not _away_path(log, each).exists()]
    with ThreadPoolExecutor(READERS) as pool:
        for number, _ in enumerate(pool.map(make, missing)):
            report_progress("reading indexes", number, len(missing), "segments")
    report_progress("reading indexes", max(len(missing), 1), max(len(missing), 1), "segments")


def stand_in_for(archive: Archive, entry: ManifestEntry, path: Path) -> None:
    """Write a file that stands for an archived segment. Raises ArchiveError also where the manifest
    has a wrong ``index_at``."""
    read = archive.store.part
    head = read(entry.object, 0, min(names.HEAD_BYTES, entry.index_at, entry.size))
    stand_in(
        path,
        entry.size,
        {0: head, entry.index_at: read(entry.object, entry.index_at, entry.size)},
    )
    try:
        file = SealedFile(path, Offset(entry.base))
        file.close()
        if file.index_at == entry.index_at:
            return
    except (LogDamaged, NotALog):
        pass
    path.unlink()
    raise ArchiveError(
        f"{archive.store.url}/{entry.name} is wrong: the index of that segment does not begin at"
        f" byte {entry.index_at:,}"
    )


_ENTRIES: Final = ".manifest.json"


def archived_log(url: str, home: Path) -> Path:
    """A log in the folder ``home`` that reads an archive: all of its segments are away. What was
    read of it before is still there, and what was archived or redacted since is taken over."""
    archive = Archive(ObjectStore(url))
    named = hashlib.sha256(archive.store.url.encode()).hexdigest()[:16]  # no part of it is a path
    log = home / "archives" / named
    make_directory_durably(log.parent)
    with file_locked(log.with_suffix(".lock")):
        _take_over(log, archive)
    return log


def _take_over(log: Path, archive: Archive) -> None:
    end = sealed_end(log)
    if end is not None and end.log_id != archive.log_id:
        _forget(log)
    make_directory_durably(log)
    log.chmod(0o700)
    known = _known_entries(log / _ENTRIES)
    there = archive.store.sizes(SEGMENTS) if known else {}
    entries = archive.entries([each for each in known if each.object in there])
    if not entries:
        raise ArchiveError(f"{archive.store.url} has no segment yet")
    if any(each not in entries for each in known):  # redacted since
        _forget(log)
        make_directory_durably(log)
    _make_away(log, archive, entries)
    last = entries[-1]
    write_sealed_end(log, SealedEnd(archive.log_id, Offset(last.base), Offset(last.following)))
    write_cache_file(log / _ENTRIES, partial(_write, msgspec.json.encode(entries)))


def _known_entries(path: Path) -> list[ManifestEntry]:
    try:
        return msgspec.json.decode(path.read_bytes(), type=list[ManifestEntry])
    except (FileNotFoundError, msgspec.MsgspecError):
        return []


def _forget(log: Path) -> None:
    """Delete what was read of an archive."""
    for folder in (log, cache_folder(log)):
        if folder.exists():
            shutil.rmtree(folder)


class Retained(NamedTuple):
    """What `retain_log` did: how many segments and bytes went ``away``, and what is still here."""

    away_segments: int
    away_bytes: int
    segments: int
    size_bytes: int


def retain_log(
    log: Path, *, before_ns: int | None = None, keep_bytes: int | None = None
) -> Retained:
    """Let the oldest segments go whose events were all logged ``before_ns``, or as many as leave
    ``keep_bytes`` here; the last sealed segment stays, and what is not archived yet. Each goes only
    after the archived one, read just now, was equal. Raises LogError, ArchiveError; what is left is
    whole then."""
    refuse_away(log, segments_of(log)[-1:])
    delete_stand_ins(log)
    place = archive_place(log)
    if place is None:
        raise LogError(
            f"{log} is not archived: run `{advised('log', 'archive', log, 'URL')}` first"
        )
    archive = Archive(ObjectStore(place.url))
    entries = {each.base: each for each in archive.entries()}
    here = [each for each in names.list_growing(log) if each.sealed and not each.away]
    size = sum(each.path.stat().st_size for each in here)
    gone = gone_bytes = 0
    for number, segment in enumerate(here[:-1]):
        report_progress("verifying", number, len(here), "segments")
        length = segment.path.stat().st_size
        if keep_bytes is not None and size - gone_bytes <= keep_bytes:
            break
        if before_ns is not None and _last_logged_ns(segment) >= before_ns:
            break
        entry = entries.get(segment.base)
        if entry is None:
            break  # not archived yet
        _check_same(log, archive, segment, entry)
        archive.check(entry)
        _let_go(log, archive, segment, entry)
        gone, gone_bytes = gone + 1, gone_bytes + length
    report_progress("verifying", max(len(here), 1), max(len(here), 1), "segments")
    return Retained(gone, gone_bytes, len(here) - gone, size - gone_bytes)


def _last_logged_ns(segment: names.SegmentPath) -> int:
    file = SealedFile(segment.path, segment.base)
    try:
        return int(file.statistics.message_end_time)
    finally:
        file.close()


def _check_same(
    log: Path, archive: Archive, segment: names.SegmentPath, entry: ManifestEntry
) -> None:
    if file_sha256(segment.path) != entry.sha256:
        raise ArchiveError(
            f"{segment.path} is not archived as it is here; run"
            f" `{advised('log', 'archive', log, archive.store.url)}`"
        )


def _let_go(log: Path, archive: Archive, segment: names.SegmentPath, entry: ManifestEntry) -> None:
    """Replace a segment by a file that stands for it, unless it was redacted meanwhile: what was
    erased would come back."""
    path = _away_path(log, entry)
    with place_locked(log):
        _check_same(log, archive, segment, entry)
        note_archive_place(log, archive.store.url, {path.name: entry.object})
        file = SealedFile(segment.path, segment.base)
        try:
            stand_in(path, entry.size, file.ends())
        finally:
            file.close()
        delete_durably(segment.path)


def _check_target(log: Path, archive: Archive, wanted: list[ManifestEntry]) -> None:
    """Raise LogError unless ``log`` is missing, empty, or has only segments to be restored."""
    if not log.exists():
        return
    if not log.is_dir():
        raise NotALog(f"{log} is a file; a log is a directory, choose another name")
    advice = "restore into a new folder"
    end = sealed_end(log)
    if end is not None and end.log_id != archive.log_id:
        raise LogError(f"{log} is log {end.log_id}, the archive of log {archive.log_id}; {advice}")
    known = {each.base: each for each in wanted}
    left_over = {path.name for path in names.leftovers(log)}
    for segment in names.segment_files(log):
        entry = known.get(segment.base)
        if not segment.sealed or entry is None:
            raise LogError(f"{segment.path} is not in the archive as asked; {advice}")
        head = names.head_of(segment.path, segment.base)
        if head["log_id"] != archive.log_id or segment.path.stat().st_size != entry.size:
            raise LogError(f"{segment.path} differs from the archived one; {advice}")
        left_over.add(segment.path.name)
    others = sorted(
        path.name
        for path in log.iterdir()
        if path.name not in {*left_over, names.LOCK} and not path.name.startswith(".")
    )
    if others:
        raise NotALog(f"{log} holds {others[0]}, which is no part of a log; {advice}")


def _fetch_segments(
    log: Path, archive: Archive, wanted: list[ManifestEntry]
) -> list[ManifestEntry]:
    total = max(sum(each.size for each in wanted) // 1_000_000, 1)
    done, fetched = 0, []
    for each in wanted:
        report_progress("restoring", min(done // 1_000_000, total), total, "MB")
        path = names.segment_path(log, Offset(each.base), names.SEALED)
        if not path.exists():
            fetch_segment(archive, each, path)
            fetched.append(each)
        elif file_sha256(path) != each.sha256:
            raise LogError(f"{path} differs from the archived one; restore into a new folder")
        done += each.size
    report_progress("restoring", total, total, "MB")
    return fetched


def fetch_segment(archive: Archive, entry: ManifestEntry, path: Path) -> None:
    """Write an archived segment durably to ``path``, all of it or nothing; one that came there
    meanwhile stays. Raises ArchiveError."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}{names.SEALING}")
    unlink_quietly(temporary)
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    try:
        archive.write_checked(entry, fd)
        sync_file(fd)
        with place_locked(path.parent):
            if not path.exists():
                replace_durably(temporary, path)
    finally:
        unlink_quietly(temporary)
        os.close(fd)


def _write(data: bytes, file: BinaryIO) -> None:
    file.write(data)


@contextlib.contextmanager
def fetched_whole(segment: names.SegmentPath) -> Iterator[Path]:
    """A file with the bytes of a segment that is away, fetched and compared with the manifest."""
    place = archive_place(segment.path.parent)
    if place is None:
        raise LogDamaged(f"{segment.path}: nothing says where this segment is archived")
    with tempfile.TemporaryDirectory(prefix="mapfold-") as folder:
        archive = Archive(ObjectStore(place.url))
        path = names.segment_path(Path(folder), segment.base, names.SEALED)
        with path.open("wb") as file:
            archive.write_checked(archive.entry_at(segment.base), file.fileno())
        yield path
