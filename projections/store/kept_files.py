"""The files of a kept history: parts of stripes, and states of folds. Reading one runs no code.

A part is an ``.npz`` as `numpy.savez` writes it, whose arrays are mapped and checked: a ZIP archive
of ``.npy`` files, here without compression, named ``NUMBER/ARRAY.npy``
by the number of the stripe. The last member, ``manifest.json``, states which log, events and
settings the file is of, and for each array the position and CRC-32 of its bytes; the archive's
comment has the position and CRC-32 of the manifest. So opening a file reads only its end; an array
is checked when it is first used, and nothing else of the archive is relied on. `numpy.load` reads
the file, too.

A state of a fold is ``magic · SHA-256 of all that follows · zlib of (length of the index, index,
arrays end to end)``. The index is JSON: the JSON values, and for each numpy array its dtype, shape
and position. Only plain number types are read; anything else is refused.
docs/decisions/history-cache.md says why neither is SQLite, Arrow or `numpy.savez`.
"""

import hashlib
import io
import json
import math
import mmap
import os
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from eventsrc.base.machine import crc32
from eventsrc.envelope.model import Offset
from eventsrc.log.log_identity import STANDS_FOR, FileSpan
from projections.fold import State

from .columns import TABLES, Array, Stripe, ends_of
from .tables import DamagedPart

FORMAT: Final = 4
_COMMENT: Final = "mapfold history {} {} {} {}"
_COMMENT_PATTERN: Final = re.compile(rb"mapfold history (\d+) (\d+) (\d+) (\d+)\Z")
_MOST_COMMENT: Final = 200
_MOST_MANIFEST: Final = 64 * 1024 * 1024
_TYPES: Final = frozenset({"|i1", "<i2", "<i4", "<i8", "<f8", "|u1"})
_LOCAL_HEADER: Final = 30
_PLAIN_DATE: Final = (1980, 1, 1, 0, 0, 0)


class Unwritable(Exception):
    """A history that cannot be written to a file; the message says why."""


def write_part(file: BinaryIO, about: Mapping[str, Any], stripes: Sequence[Stripe]) -> None:
    """Write stripes and ``about``, which states what they are of, to a new file. Raises OSError,
    and Unwritable for a number of more than 64 bits."""
    documents = []
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        for number, stripe in enumerate(stripes):
            arrays = {
                name: _write_array(archive, f"{number}/{name}.npy", array)
                for name, array in stripe.arrays.items()
            }
            document = {"start": stripe.start, "end": stripe.end, "rows": dict(stripe.rows)}
            documents.append(document | {"arrays": arrays})
        manifest = json.dumps({"about": dict(about), "stripes": documents}).encode()
        at = _write_member(archive, "manifest.json", manifest)
        comment = _COMMENT.format(FORMAT, at, len(manifest), crc32(manifest))
        archive.comment = comment.encode()


def _write_array(archive: zipfile.ZipFile, name: str, array: Array) -> "_ArrayLocation":
    """Write an array and return its location."""
    little = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
    if little.dtype.str not in _TYPES:
        raise Unwritable(f"{name} has numbers of more than 64 bits")
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(little))
    at = _write_member(archive, name, head.getvalue(), little.data)
    crc = crc32(little.data, crc32(head.getvalue()))
    return _ArrayLocation(little.dtype.str, len(little), at, len(head.getvalue()), crc)


def _write_member(archive: zipfile.ZipFile, name: str, *content: bytes | memoryview) -> int:
    """Write a member of the archive and return the byte at which its content begins."""
    info = zipfile.ZipInfo(name, _PLAIN_DATE)
    info.file_size = sum(memoryview(each).nbytes for each in content)
    with archive.open(info, "w") as member:
        for each in content:
            member.write(each)
    return info.header_offset + _LOCAL_HEADER + len(name.encode()) + len(info.extra)


class PartFile:
    """An open file of stripes. Raises OSError, and DamagedPart for one that is not as written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(fd, "rb") as file:
            try:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except ValueError:
                raise DamagedPart(f"{path} is empty") from None
        self._locations: list[_ArrayLocation] = []
        manifest = self._manifest()
        self.about: dict[str, Any] = manifest["about"]
        self.stripes = [self._stripe(document) for document in manifest["stripes"]]
        ends = [(stripe.start, stripe.end) for stripe in self.stripes]
        if not ends or any(a[1] != b[0] for a, b in pairwise(ends)):
            raise DamagedPart(f"{path} has stripes that are not end to end")

    @property
    def span(self) -> tuple[Offset, Offset]:
        """The first offset, and the one after the last."""
        return self.stripes[0].start, self.stripes[-1].end

    def release(self) -> None:
        """Drop the file's pages from this process's memory; access reads them again."""
        _release(self._map, 0, len(self._map))

    def spans(self) -> list[FileSpan]:
        """The spans of the file: one for each array, and for the manifest."""
        at = [(each.at, np.dtype(each.dtype).itemsize) for each in self._locations]
        return [FileSpan(0), *(FileSpan(*each) for each in sorted(at)), FileSpan(self._manifest_at)]

    def _manifest(self) -> dict[str, Any]:
        try:
            return self._read_manifest()
        except DamagedPart:
            if not _fetch(self.path, len(self._map) - 1, None):
                raise
        return self._read_manifest()

    def _read_manifest(self) -> dict[str, Any]:
        size = len(self._map)
        found = _COMMENT_PATTERN.search(self._map[max(0, size - _MOST_COMMENT) :])
        if found is None or int(found[1]) != FORMAT:
            raise DamagedPart(f"{self.path} does not end as a history of this version does")
        at, length, crc = (int(found[i]) for i in (2, 3, 4))
        if at + length > size or length > _MOST_MANIFEST:
            raise DamagedPart(f"{self.path} is cut off")
        data = self._map[at : at + length]
        if crc32(data) != crc:
            raise DamagedPart(f"{self.path}: the checksum of its manifest does not match")
        manifest: dict[str, Any] = json.loads(data)
        self._manifest_at = at
        return manifest

    def _stripe(self, document: dict[str, Any]) -> Stripe:
        locations = {
            name: _ArrayLocation(*location) for name, location in document["arrays"].items()
        }
        for table, count in document["rows"].items():
            for column, kind in TABLES[table].items():
                name = f"{table}.{column}"
                if locations[ends_of(name) if kind == "text" else name].length != count:
                    raise DamagedPart(f"{self.path}: {name} is not as long as its table")
        if any(
            location.dtype not in _TYPES or min(location[1:]) < 0 for location in locations.values()
        ):
            raise DamagedPart(f"{self.path} has arrays of another kind")
        self._locations += locations.values()
        arrays = _MappedArrays(self.path, self._map, locations)
        start, end = Offset(document["start"]), Offset(document["end"])
        return Stripe(start, end, document["rows"], arrays, self.release)


class _ArrayLocation(NamedTuple):
    """The location of an array: its dtype and length, the byte at which its member begins, the
    length of the member's header, and the CRC-32 of header and array."""

    dtype: str
    length: int
    at: int
    head: int
    crc: int


class _MappedArrays(Mapping[str, Array]):
    """Arrays in a mapped file by name; the checksum of each is checked on first access."""

    def __init__(
        self, path: Path, data: mmap.mmap, locations: Mapping[str, _ArrayLocation]
    ) -> None:
        self._path, self._data, self._locations = path, data, locations
        self._checked: dict[str, Array] = {}

    def __len__(self) -> int:
        return len(self._locations)

    def __iter__(self) -> Iterator[str]:
        return iter(self._locations)

    def __getitem__(self, name: str) -> Array:
        if name not in self._checked:
            self._checked[name] = self._check(self._locations[name])
        return self._checked[name]

    def _check(self, location: _ArrayLocation) -> Array:
        start = location.at + location.head
        end = start + location.length * np.dtype(location.dtype).itemsize
        if end > len(self._data):
            raise DamagedPart(f"{self._path} is cut off")
        if not self._is_right(location, end) and not (
            _fetch(self._path, location.at, end) and self._is_right(location, end)
        ):
            raise DamagedPart(f"{self._path}: a checksum does not match at byte {location.at:,}")
        _release(self._data, location.at, end)
        return np.frombuffer(self._data, location.dtype, location.length, start)

    def _is_right(self, location: _ArrayLocation, end: int) -> bool:
        with memoryview(self._data)[location.at : end] as member:
            return crc32(member) == location.crc


def _fetch(path: Path, start: int, end: int | None) -> bool:
    """Fetch bytes of a file that stands for one in an archive; False if it does not."""
    if not path.with_name(path.name + STANDS_FOR).exists():
        return False
    from eventsrc.log.archived_history import fetch_kept  # here: few logs are read from an archive

    return fetch_kept(path, start, end)


def spans_of(path: Path) -> list[FileSpan]:
    """The spans in which a file is archived. Raises OSError, DamagedPart."""
    return PartFile(path).spans() if path.suffix == ".npz" else [FileSpan(0)]


def _release(data: mmap.mmap, start: int, end: int) -> None:
    """Drop the whole pages of a range from memory: a checksum reads all of them, and mostly few
    rows are used afterwards."""
    first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    length = end // mmap.PAGESIZE * mmap.PAGESIZE - first
    if length > 0 and hasattr(mmap, "MADV_DONTNEED"):
        data.madvise(mmap.MADV_DONTNEED, first, length)


MAGIC = b"mapfold snapshot 1\n"
_STATE_TYPES = frozenset({"<i2", "<i4", "<i8", "<f4", "<f8", "|u1", "<u4", "|i1"})
_LENGTH_BYTES = 8
_MAX_RATIO = 16
_ALWAYS_ALLOWED_BYTES = 64 * 1024 * 1024
"""A state that decompresses to more than this, and to more than `_MAX_RATIO` times its size, is
refused. Those measured decompress to four times their size."""


class MalformedState(ValueError):
    """Raised for bytes that are no state of this version, or a damaged one; the message says
    how."""


def pack(values: State) -> bytes:
    """Arrays and JSON values by name as bytes. Raises TypeError for an array of another type."""
    plain: dict[str, Any] = {}
    arrays: dict[str, tuple[str, tuple[int, ...], int]] = {}
    blobs: list[bytes] = []
    at = 0
    for name, value in values.items():
        if not isinstance(value, np.ndarray):
            plain[name] = value
            continue
        little = value.astype(value.dtype.newbyteorder("<"), copy=False)
        if little.dtype.str not in _STATE_TYPES:
            raise TypeError(f"{name} is an array of {little.dtype.str}, which no state file holds")
        blobs.append(little.tobytes())
        arrays[name] = (little.dtype.str, little.shape, at)
        at += len(blobs[-1])
    index = json.dumps({"plain": plain, "arrays": arrays}, allow_nan=False).encode()
    body = zlib.compress(b"".join([len(index).to_bytes(_LENGTH_BYTES, "little"), index, *blobs]), 1)
    return MAGIC + hashlib.sha256(body).digest() + body


def read_state(path: Path) -> State:
    """The values that a regular file has as bytes of `pack`. Raises OSError, DamagedPart,
    MalformedState."""
    with os.fdopen(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise DamagedPart("it is not a regular file")
        try:
            return unpack(file.read())
        except MalformedState:
            if not _fetch(path, 0, None):
                raise
        file.seek(0)
        return unpack(file.read())


def unpack(data: bytes) -> State:
    """The values of `pack`. Raises MalformedState."""
    head = len(MAGIC) + hashlib.sha256().digest_size
    if not data.startswith(MAGIC):
        raise MalformedState("it does not begin like a fold of this version")
    body = data[head:]
    if hashlib.sha256(body).digest() != data[len(MAGIC) : head]:
        raise MalformedState("its checksum does not match")
    content = _decompress(body)
    start = _LENGTH_BYTES + int.from_bytes(content[:_LENGTH_BYTES], "little")
    index = json.loads(content[_LENGTH_BYTES:start])
    values: State = index["plain"]
    for name, (dtype, shape, at) in index["arrays"].items():
        if dtype not in _STATE_TYPES:
            raise MalformedState(f"{name} is of the type {dtype!r}")
        flat = np.frombuffer(content, dtype, math.prod(shape), start + at)
        values[name] = flat.reshape(shape).copy()
    return values


def _decompress(body: bytes) -> bytes:
    """Decompress up to a limit: a forged file has a right checksum, too."""
    limit = max(_ALWAYS_ALLOWED_BYTES, _MAX_RATIO * len(body))
    stream = zlib.decompressobj()
    content = stream.decompress(body, limit)
    if not stream.eof:
        raise MalformedState(f"it is cut off, or decompresses to more than {limit:,} bytes")
    return content
