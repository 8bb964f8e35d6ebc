"""Forged commit marks (docs/log-format.md)."""

import re
import struct
import zlib
from itertools import count

_MARK = struct.Struct("<BQQQ")
_SEED = re.compile(rb"mark_seed\x08\0\0\0([0-9a-f]{8})")


def mark(first: int, following: int, seed: int = 0) -> bytes:
    """The mark of a chunk that would hold ``first`` … ``following`` - 1."""
    head = _MARK.pack(0x80, 20, first, following)
    return head + struct.pack("<I", zlib.crc32(head) ^ seed)


def seed_of(segment: bytes) -> int:
    """The seed of the marks of a growing segment, read from the file; 0 if it has none."""
    found = _SEED.search(segment)
    return int(found[1], 16) if found else 0


def mark_as_text(first: int) -> str:
    """A mark for an offset from about ``first`` on that can stand in a key: as UTF-8 it ends in the
    bytes of the mark."""
    for following in count(first):
        try:
            text = (b"\xc2" + mark(0, following)).decode()
        except UnicodeDecodeError:
            continue
        if not set(text) & set("*$?#/"):
            return text
    raise AssertionError("count() ends never")
