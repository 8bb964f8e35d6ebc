"""Bring a log back from its archive (`eventsrc.log.archive`).

Restoring writes `.sealed.json` first, with the end that the log will have. So a log that is not
restored to its end is one with missing segments: readers and recorders refuse it by themselves.
"""

import contextlib
import os
import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO, Final

from eventsrc.base.errors import ArchiveError, LogError, NotALog, ObjectMissing
from eventsrc.base.machine import system_clock
from eventsrc.base.progress import report_progress
from eventsrc.envelope.model import Offset

from . import format as names
from .archive import KEPT, Archive, ManifestEntry
from .durable_files import make_directory_durably, replace_durably, sync_file, unlink_quietly
from .lock import WriterLock
from .log_identity import cache_folder, make_cache_folder, write_cache_file
from .seal import file_sha256
from .sealed_end import SealedEnd, sealed_end, write_sealed_end

_KEPT_NAME: Final = re.compile(r"[0-9a-f]{16}-(?:\d{20}-)?(\d{20})(?:\.\d+)?\.\w+")


@dataclass(frozen=True, slots=True)
class Restored:
    """What `restore_log` did: the ``fetched`` segments and bytes, and what the log has now."""

    log_id: str
    fetched_segments: int
    fetched_bytes: int
    segments: int
    events: int


def restore_log(archive: Archive, log: Path, *, until: Offset | None = None) -> Restored:
    """Bring back the segments that hold the first ``until`` events, all for None, and the kept
    history of these. A log that was restored in part is restored further. Raises ArchiveError, and
    LogError if ``log`` is another log or has anything that the archive has not."""
    entries = archive.entries()
    if not entries:
        raise ArchiveError(f"{archive.store.url} has no segment yet")
    wanted = [each for each in entries if until is None or each.base < max(until, 1)]
    _check_target(log, archive, wanted)
    make_directory_durably(log)
    with WriterLock(log, system_clock):
        _check_target(log, archive, wanted)
        last = wanted[-1]
        end = SealedEnd(archive.log_id, Offset(last.base), Offset(last.following))
        if sealed_end(log) != end:
            write_sealed_end(log, end)
        fetched = _fetch_segments(log, archive, wanted)
    _fetch_kept(log, archive, Offset(last.following))
    return Restored(
        archive.log_id, len(fetched), sum(e.size for e in fetched), len(wanted), last.following
    )


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
    """Write an archived segment durably to ``path``, all of it or nothing. Raises ArchiveError."""
    temporary = names.segment_path(path.parent, Offset(entry.base), names.SEALING)
    unlink_quietly(temporary)
    fd = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    try:
        archive.write_checked(entry, fd)
        sync_file(fd)
        replace_durably(temporary, path)
    except BaseException:
        unlink_quietly(temporary)
        raise
    finally:
        os.close(fd)


def _fetch_kept(log: Path, archive: Archive, end: Offset) -> None:
    """Bring back the kept history of the first ``end`` events. What the archiver deletes meanwhile
    is left out: it has put others in its place."""
    for name, size in archive.kept_files().items():
        found = _KEPT_NAME.fullmatch(name)
        path = cache_folder(log) / name
        if found is None or int(found[1]) > end or (path.exists() and path.stat().st_size == size):
            continue
        make_cache_folder(log)
        with contextlib.suppress(ObjectMissing):
            data = archive.store.read(KEPT + name)
            write_cache_file(path, partial(_write, data))


def _write(data: bytes, file: BinaryIO) -> None:
    file.write(data)
