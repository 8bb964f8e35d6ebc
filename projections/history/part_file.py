"""Stripes as a file: an ``.npz`` as `numpy.savez` writes it, whose arrays are mapped and checked.

A ``.npz`` is a ZIP archive of ``.npy`` files, here without compression, named ``NUMBER/ARRAY.npy``
by the number of the stripe. The last member, ``manifest.json``, says what the file is of, and for
each array where its bytes are and their CRC-32; the archive's comment says where the manifest is,
and its CRC-32. So opening a file reads its end only; an array is checked when it is first used, and
nothing else of the archive is relied on. `numpy.load` reads the file, too.

docs/decisions/history-cache.md says why it is not SQLite, Arrow or a folder of arrays.
"""

import io
import json
import mmap
import os
import re
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from eventsrc.crc import crc32
from eventsrc.envelope import Offset

from .columns import TABLES, Array, Stripe, ends_of
from .tables import DamagedPart

FORMAT: Final = 1
_COMMENT: Final = "mapfold history {} {} {} {}"
_COMMENT_PATTERN: Final = re.compile(rb"mapfold history (\d+) (\d+) (\d+) (\d+)\Z")
_MOST_COMMENT: Final = 200
_MOST_MANIFEST: Final = 64 * 1024 * 1024
_TYPES: Final = frozenset({"|i1", "<i2", "<i4", "<i8", "<f8", "|u1"})
_LOCAL_HEADER: Final = 30
_PLAIN_DATE: Final = (1980, 1, 1, 0, 0, 0)


class Unwritable(Exception):
    """A history that no file holds; the message says why."""


def write_part(file: BinaryIO, about: Mapping[str, Any], stripes: Sequence[Stripe]) -> None:
    """Write stripes, and what they are of, to a new file. Raises OSError, and Unwritable for a
    number of more than 64 bits."""
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


def _write_array(archive: zipfile.ZipFile, name: str, array: Array) -> "_Place":
    """Write an array; where it is then."""
    little = np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False))
    if little.dtype.str not in _TYPES:
        raise Unwritable(f"{name} has numbers of more than 64 bits")
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(little))
    member = head.getvalue() + little.tobytes()
    at = _write_member(archive, name, member)
    return _Place(little.dtype.str, len(little), at, len(head.getvalue()), crc32(member))


def _write_member(archive: zipfile.ZipFile, name: str, content: bytes) -> int:
    """Where the content begins in the file."""
    info = zipfile.ZipInfo(name, _PLAIN_DATE)
    archive.writestr(info, content)
    return info.header_offset + _LOCAL_HEADER + len(name.encode()) + len(info.extra)


class Part:
    """An open file of stripes. Raises OSError, and DamagedPart for one that is not as written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        fd = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
        with os.fdopen(fd, "rb") as file:
            try:
                self._map = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            except ValueError:
                raise DamagedPart(f"{path} is empty") from None
        manifest = self._manifest()
        self.about: dict[str, Any] = manifest["about"]
        self.stripes = [self._stripe(document) for document in manifest["stripes"]]
        ends = [(stripe.start, stripe.end) for stripe in self.stripes]
        if not ends or any(a[1] != b[0] for a, b in pairwise(ends)):
            raise DamagedPart(f"{path} has stripes that are not end to end")

    @property
    def span(self) -> tuple[Offset, Offset]:
        """The first offset, and that after the last."""
        return self.stripes[0].start, self.stripes[-1].end

    def release(self) -> None:
        """Take what was read out of this process's memory; it is read again where it is used."""
        _release(self._map, 0, len(self._map))

    def _manifest(self) -> dict[str, Any]:
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
        return manifest

    def _stripe(self, document: dict[str, Any]) -> Stripe:
        places = {name: _Place(*place) for name, place in document["arrays"].items()}
        for table, count in document["rows"].items():
            for column, kind in TABLES[table].items():
                name = f"{table}.{column}"
                if places[ends_of(name) if kind == "text" else name].length != count:
                    raise DamagedPart(f"{self.path}: {name} is not as long as its table")
        if any(place.dtype not in _TYPES or min(place[1:]) < 0 for place in places.values()):
            raise DamagedPart(f"{self.path} has arrays of another kind")
        arrays = _MappedArrays(self.path, self._map, places)
        start, end = Offset(document["start"]), Offset(document["end"])
        return Stripe(start, end, document["rows"], arrays, self.release)


class _Place(NamedTuple):
    """Where an array is: its dtype and length, where the member begins, the length of the member's
    header, and the CRC-32 of both."""

    dtype: str
    length: int
    at: int
    head: int
    crc: int


class _MappedArrays(Mapping[str, Array]):
    """Arrays in a mapped file by name; each is checked when it is first asked for."""

    def __init__(self, path: Path, data: mmap.mmap, places: Mapping[str, _Place]) -> None:
        self._path, self._data, self._places = path, data, places
        self._checked: dict[str, Array] = {}

    def __len__(self) -> int:
        return len(self._places)

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __getitem__(self, name: str) -> Array:
        if name not in self._checked:
            self._checked[name] = self._check(self._places[name])
        return self._checked[name]

    def _check(self, place: _Place) -> Array:
        start = place.at + place.head
        end = start + place.length * np.dtype(place.dtype).itemsize
        if end > len(self._data):
            raise DamagedPart(f"{self._path} is cut off")
        with memoryview(self._data)[place.at : end] as member:
            if crc32(member) != place.crc:
                raise DamagedPart(f"{self._path}: a checksum does not match at byte {place.at:,}")
        _release(self._data, place.at, end)
        return np.frombuffer(self._data, place.dtype, place.length, start)


def _release(data: mmap.mmap, start: int, end: int) -> None:
    """Let go of the whole pages in a range, until something in them is used again: mostly a few
    rows are, of what a checksum had to read."""
    first = -(-start // mmap.PAGESIZE) * mmap.PAGESIZE
    length = end // mmap.PAGESIZE * mmap.PAGESIZE - first
    if length > 0 and hasattr(mmap, "MADV_DONTNEED"):
        data.madvise(mmap.MADV_DONTNEED, first, length)
