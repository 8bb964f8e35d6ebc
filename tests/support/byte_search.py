"""Look for bytes in all files of a folder, also inside what is compressed there."""

import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

import zstandard

_ZSTD, _ZLIB = b"\x28\xb5\x2f\xfd", (b"\x78\x01", b"\x78\x5e", b"\x78\x9c", b"\x78\xda")


def holds(folder: Path, needles: Iterable[bytes]) -> list[tuple[str, bytes]]:
    """The file and the bytes found, of all ``needles``; empty if none is anywhere."""
    wanted = list(needles)
    return [
        (str(path.relative_to(folder)), needle)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        for content in contents(path.read_bytes())
        for needle in wanted
        if needle in content
    ]


def contents(data: bytes) -> Iterator[bytes]:
    """The bytes of a file, and of everything in it that zstd or zlib can decompress."""
    yield data
    for at in _places(data, _ZSTD):
        try:
            yield zstandard.ZstdDecompressor().decompressobj().decompress(data[at:])
        except zstandard.ZstdError:
            continue
    for magic in _ZLIB:
        for at in _places(data, magic):
            try:
                yield zlib.decompressobj().decompress(data[at:])
            except zlib.error:
                continue


def _places(data: bytes, magic: bytes) -> Iterator[int]:
    at = data.find(magic)
    while at >= 0:
        yield at
        at = data.find(magic, at + 1)
