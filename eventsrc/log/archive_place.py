"""Where the segments of a log are that are away, and the files that stand for them.

``LOG/.archive.json`` has the URL of the archive, and the object of each segment that is away. It
is changed, and a file that stands for a segment takes its place or gives it back, under
`place_locked` only, so that any number of commands may do so at once. A segment goes in three
steps: its place is noted, its stand-in made, its file deleted. It comes back in two: its file is
there, its stand-in is deleted. So after a kill both may be there: the segment counts, and
`delete_stand_ins` ends it.
"""

import contextlib
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec

from eventsrc.base.errors import LogDamaged, LogError
from eventsrc.base.text import advised, command_line

from .durable_files import (
    delete_durably,
    replace_durably,
    sync_file,
    unlink_quietly,
    write_all,
)
from .format import ARCHIVE, ARCHIVE_LOCK, SEALED, SEALING, SegmentPath, segment_files
from .lock import file_locked


class ArchivePlace(msgspec.Struct, frozen=True):
    """Where a log is archived: a URL, and by the name of its file the object of each segment that
    is away."""

    url: str
    objects: Mapping[str, str] = msgspec.field(default_factory=dict)


def archive_place(log: Path) -> ArchivePlace | None:
    """Where a log is archived; None if it has never been. Raises LogDamaged, OSError."""
    try:
        return msgspec.json.decode((log / ARCHIVE).read_bytes(), type=ArchivePlace)
    except FileNotFoundError:
        return None
    except msgspec.MsgspecError as error:
        raise LogDamaged(
            f"{log / ARCHIVE} is not what mapfold writes ({error}); delete it and run"
            f" `{advised('log', 'archive', log, 'URL')}`"
        ) from None


def refuse_away(log: Path, segments: Sequence[SegmentPath]) -> None:
    """Raise LogError, with what to do, if one of ``segments`` is away. Raises OSError."""
    away = [each for each in segments if each.away]
    if away:
        place = archive_place(log)
        url = "URL" if place is None else place.url
        if segments[-1].away:  # of a log that was thinned out here the last segment stays
            raise LogError(
                f"{url} is an archive, which is only read here; to write, bring the log back:"
                f" `{command_line('log', 'restore', url, 'LOG')}`, and name LOG instead"
            )
        raise LogError(
            f"{away[0].path}: this segment is in the archive only;"
            f" `{advised('log', 'restore', url, log)}` brings it back"
        )


@contextlib.contextmanager
def place_locked(log: Path) -> Iterator[None]:
    """Wait for the lock, which each holder has for moments. Raises OSError."""
    with file_locked(log / ARCHIVE_LOCK):
        yield


def note_archive_place(log: Path, url: str, away: Mapping[str, str] | None = None) -> None:
    """Write where a log is archived, durably; ``away`` has the objects of more segments away, by
    the names of their files. Another ``url`` for none of them does not replace one where segments
    are. The caller has `place_locked`. Raises OSError."""
    before = archive_place(log)
    known = {} if before is None else before.objects
    is_same = before is not None and before.url == url
    if known and not is_same and not away:
        return
    place = ArchivePlace(url, {**(known if is_same else {}), **(away or {})})
    if place != before:
        data = msgspec.json.format(msgspec.json.encode(place, order="sorted"), indent=1)
        stand_in(log / ARCHIVE, len(data), {0: data})


def delete_stand_ins(log: Path) -> None:
    """Delete what stands for segments that are here again, as it may hold some of their events,
    and what a killed process has left of a note. Raises OSError."""
    if _needless(log):
        with place_locked(log):
            for path in _needless(log):
                delete_durably(path)


def _needless(log: Path) -> list[Path]:
    files = segment_files(log)
    here = {each.base for each in files if each.path.name.endswith(SEALED)}
    notes = log.glob(f"{ARCHIVE}.*{SEALING}")  # only the holder of the lock makes one
    return [*(each.path for each in files if each.away and each.base in here), *notes]


def stand_in(path: Path, size: int, parts: Mapping[int, bytes]) -> None:
    """Write a file of ``size`` bytes durably that has only these ``parts``, by position: for a
    segment away its head and what is behind its chunks. Raises OSError."""
    beside = path.with_name(f"{path.name}.{os.getpid()}{SEALING}")
    unlink_quietly(beside)
    fd = os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o644)
    try:
        os.ftruncate(fd, size)
        for at, data in parts.items():
            os.lseek(fd, at, os.SEEK_SET)
            write_all(fd, data)
        sync_file(fd)
        replace_durably(beside, path)
    except BaseException:
        unlink_quietly(beside)
        raise
    finally:
        os.close(fd)
