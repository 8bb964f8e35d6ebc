"""The kept history of a log in its archive: packed, brought back whole, or read by ranges.

    kept/NAME.packed    the file NAME of the cache folder, in spans that are packed one by one, end
                        to end; then a `_Index`, packed too; then its length in 8 bytes and `_END`

A span begins where `FileSpan` says and ends where the next does. It is compressed by zstd as it is,
or with the first bytes of all its numbers first, then the second ones …: what is smaller. That
takes a quarter for columns of numbers.

Of a log that is read by its URL the files stand for those in the archive: as long, and empty.
``NAME.away`` beside each says what spans of which object it is made of. Every reader of these files
compares what it reads with a checksum; what does not match is fetched, and compared again.
"""

import contextlib
import mmap
import re
from bisect import bisect_left, bisect_right
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import accumulate, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, Final

import msgspec
import numpy as np
import zstandard

from eventsrc.base.errors import ArchiveError, NoSuchObject
from eventsrc.base.object_store import ObjectStore
from eventsrc.base.progress import report_progress
from eventsrc.envelope.model import FIRST_OFFSET, Offset

from . import format as names
from .archive import KEPT, Archive
from .archive_place import archive_place, stand_in
from .log_identity import STANDS_FOR, FileSpan, cache_folder, make_cache_folder, write_cache_file
from .sealed_end import sealed_end

_NAME: Final = re.compile(r"[0-9a-f]{16}-(?:\d{20}-)?(\d{20})(?:\.\d+)?\.\w+")
_PACKED: Final = ".packed"
_END: Final = b"mapfold1"
_LENGTH_BYTES: Final = 8
_TAIL_BYTES: Final = 8 * 1024
"""What is read of the end of an object first; the index of a short history takes less."""
_ALLOWED_BYTES: Final = 64 * 1024 * 1024
_MOST_RATIO: Final = 1000
"""An index unpacks to at most `_ALLOWED_BYTES`, and a file to at most these or `_MOST_RATIO` times
its object: what says more would take terabytes here. Those measured unpack to five times."""
_MOST_NUMBER_BYTES: Final = 8
_AT_ONCE: Final = 32 * 1024
"""Bytes that a request fetches of the spans behind the one that is asked for, if these are short:
what is read with it mostly lies behind it."""


class _Damaged(Exception):
    """An object is not as it was put. The history can do without: it is folded again."""


class _Index(msgspec.Struct, frozen=True):
    """The spans of a file of ``size`` bytes: where each begins in the file, how long it is in the
    object, and the bytes of its numbers, 1 if it was compressed as it is."""

    size: int
    starts: list[int]
    lengths: list[int]
    number_bytes: list[int]

    def __post_init__(self) -> None:
        edges = [0, *self.starts[1:], self.size]
        is_whole = len(self.starts) == len(self.lengths) == len(self.number_bytes) > 0
        if not is_whole or self.starts[0] or any(a > b for a, b in pairwise(edges)):
            raise ValueError("its spans are not end to end")
        if min(*self.lengths, *self.number_bytes) < 1:
            raise ValueError("it has a span of no bytes")
        most = max(_ALLOWED_BYTES, _MOST_RATIO * sum(self.lengths))
        if self.size > most or max(self.number_bytes) > _MOST_NUMBER_BYTES:
            raise ValueError("it is of more than such an object holds")

    def end(self, number: int) -> int:
        """Where a span ends in the file."""
        return self.starts[number + 1] if number + 1 < len(self.starts) else self.size


def _unpack_into(index: _Index, data: bytes, spans: range, file: BinaryIO) -> None:
    """Write some spans, of which ``data`` is, into their places. Raises _Damaged."""
    at = 0
    for number in spans:
        start, length = index.starts[number], index.lengths[number]
        size = index.end(number) - start
        raw = _unpacked(data[at : at + length], size, size)
        file.seek(start)
        file.write(_by_number(raw, index.number_bytes[number]))
        at += length


class _Stand(msgspec.Struct, frozen=True):
    """What a file of the cache folder stands for."""

    url: str
    object: str
    index: _Index


def archive_kept(log: Path, store: ObjectStore, files: Mapping[str, Sequence[FileSpan]]) -> int:
    """Put these files of the kept history of a log, each in spans that begin at byte 0, and delete
    those in the archive that are not among them; returns the number of bytes put."""
    there = Archive(store).kept_files()
    put = 0
    for number, (name, spans) in enumerate(files.items()):
        report_progress("archiving the kept history", number, len(files), "files")
        if name + _PACKED not in there:
            with TemporaryDirectory(prefix="mapfold-") as folder:
                packed = Path(folder) / name
                _pack(cache_folder(log) / name, spans, packed)
                if store.put_new(f"{KEPT}{name}{_PACKED}", packed):
                    put += packed.stat().st_size
    report_progress("archiving the kept history", max(len(files), 1), max(len(files), 1), "files")
    for name in there.keys() - {each + _PACKED for each in files}:
        store.delete(KEPT + name)
    return put


def _pack(source: Path, spans: Sequence[FileSpan], target: Path) -> None:
    compressor = zstandard.ZstdCompressor(write_checksum=True)
    lengths, widths = list[int](), list[int]()
    with source.open("rb") as file, target.open("wb") as packed:
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            size = len(data)
            for (start, width), (end, _) in pairwise([*spans, FileSpan(size)]):
                raw = data[start:end]
                found = compressor.compress(raw)
                if width > 1 and len(by_byte := compressor.compress(_by_byte(raw, width))) < len(
                    found
                ):
                    found = by_byte
                else:
                    width = 1
                packed.write(found)
                lengths.append(len(found))
                widths.append(width)
        index = _Index(size, [each.start for each in spans], lengths, widths)
        tail = compressor.compress(msgspec.json.encode(index))
        packed.write(tail + len(tail).to_bytes(_LENGTH_BYTES, "little") + _END)


def _by_byte(raw: bytes, width: int) -> bytes:
    """The first byte of each number, then the second …; then what is left over."""
    whole = len(raw) // width * width
    return np.frombuffer(raw[:whole], np.uint8).reshape(-1, width).T.tobytes() + raw[whole:]


def _by_number(raw: bytes, width: int) -> bytes:
    """The bytes that `_by_byte` was given."""
    whole = len(raw) // width * width
    return np.frombuffer(raw[:whole], np.uint8).reshape(width, -1).T.tobytes() + raw[whole:]


def _unpacked(data: bytes, least: int, most: int) -> bytes:
    try:
        if least <= zstandard.frame_content_size(data) <= most:  # else it may say terabytes
            return zstandard.ZstdDecompressor().decompress(data)
    except zstandard.ZstdError:
        pass
    raise _Damaged


def _read_index(store: ObjectStore, name: str, size: int) -> _Index:
    """The index of a packed object of ``size`` bytes. Raises ArchiveError, _Damaged."""
    if size < len(_END) + _LENGTH_BYTES:
        raise _Damaged
    tail = _part(store, name, max(0, size - _TAIL_BYTES), size)
    length = int.from_bytes(tail[-len(_END) - _LENGTH_BYTES : -len(_END)], "little")
    start = size - len(_END) - _LENGTH_BYTES - length
    if not tail.endswith(_END) or start < 0:
        raise _Damaged
    if start < size - len(tail):
        tail = _part(store, name, start, size)
    data = tail[len(tail) - (size - start) :][:length]
    with contextlib.suppress(msgspec.MsgspecError):
        index = msgspec.json.decode(_unpacked(data, 0, _ALLOWED_BYTES), type=_Index)
        if sum(index.lengths) == start:
            return index
    raise _Damaged


def _part(store: ObjectStore, name: str, start: int, end: int) -> bytes:
    """Bytes ``start`` to before ``end`` of an object. Raises ArchiveError, _Damaged if it has been
    cut off since it was listed."""
    try:
        return store.part(name, start, end)
    except NoSuchObject:
        raise
    except ArchiveError:
        if store.sizes(KEPT).get(name, 0) < end:
            raise _Damaged from None
        raise


def restore_kept(log: Path, archive: Archive, end: Offset) -> None:
    """Bring back the kept history of the first ``end`` events. What the archiver deletes meanwhile
    is left out: it has put others in its place."""
    for name, path, size in _files(log, archive, end):
        if not path.exists():
            with contextlib.suppress(NoSuchObject, _Damaged):
                index = _read_index(archive.store, name, size)
                of = index, archive.store.read(name), range(len(index.starts))
                write_cache_file(path, partial(_unpack_into, *of))


def stand_for_kept(log: Path) -> None:
    """Make the files that stand for the archived history of a log that is read by its URL, if there
    is one, and delete those of objects that the archiver has replaced."""
    last, place = names.list_growing(log)[-1], archive_place(log)
    if not last.away or place is None:
        return
    archive, end = Archive(ObjectStore(place.url)), sealed_end(log)
    found = list(_files(log, archive, end.following if end else FIRST_OFFSET))
    there = {_beside(path) for _, path, _ in found}
    for beside in cache_folder(log).glob(f"*{STANDS_FOR}"):
        path = beside.with_name(beside.name.removesuffix(STANDS_FOR))
        if beside not in there or not path.exists():
            path.unlink(missing_ok=True)
            beside.unlink(missing_ok=True)
    for name, path, size in found:
        if not path.exists():
            with contextlib.suppress(NoSuchObject, _Damaged):
                index = _read_index(archive.store, name, size)
                data = msgspec.json.encode(_Stand(place.url, name, index))
                write_cache_file(_beside(path), partial(_write, data))
                stand_in(path, index.size, {})


def _files(log: Path, archive: Archive, end: Offset) -> list[tuple[str, Path, int]]:
    """The archived files of the history of at most ``end`` events: object, file, and the size of
    the object."""
    sizes = {n: s for n, s in archive.kept_files().items() if n.endswith(_PACKED)}
    named = ((_NAME.fullmatch(name.removesuffix(_PACKED)), name) for name in sizes)
    found = [(each[0], name) for each, name in named if each is not None and int(each[1]) <= end]
    if found:
        make_cache_folder(log)
    return [(KEPT + name, cache_folder(log) / file, sizes[name]) for file, name in found]


def _write(data: bytes, file: BinaryIO) -> None:
    file.write(data)


def _beside(path: Path) -> Path:
    return path.with_name(path.name + STANDS_FOR)


def fetch_kept(path: Path, start: int, end: int | None = None) -> bool:
    """Fetch the bytes ``start`` to before ``end`` (None: all behind) of a file that stands for one
    in an archive, into it, unless that is gone or damaged; False if it stands for none. Raises
    ArchiveError, OSError."""
    try:
        stand = msgspec.json.decode(_beside(path).read_bytes(), type=_Stand)
    except (FileNotFoundError, msgspec.MsgspecError):
        return False
    index = stand.index
    at = list(accumulate(index.lengths, initial=0))
    first = bisect_right(index.starts, start) - 1
    last = bisect_left(index.starts, index.size if end is None else end)
    while last < len(index.starts) and at[last + 1] - at[first] <= _AT_ONCE:
        last += 1
    with contextlib.suppress(NoSuchObject, _Damaged):
        data = _part(ObjectStore(stand.url), stand.object, at[first], at[last])
        with path.open("r+b") as file:
            _unpack_into(index, data, range(first, last), file)
    return True
