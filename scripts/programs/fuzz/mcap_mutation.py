"""Mutations of an MCAP file: a record is changed and its CRC recomputed."""

import random
import struct
import zlib
from collections.abc import Iterator

from mcap.opcode import Opcode

from eventsrc.log.mcap_records import FRAME, MAGIC, MARK_OPCODE
from scripts.programs.attack.corruption import corrupt_bytes

_CHUNK = struct.Struct("<QQQII")
_U64 = struct.Struct("<Q")


def mutate_mcap(data: bytes, rng: random.Random) -> bytes:
    """One record is changed, doubled, dropped or moved; or the file as bytes, one time in ten."""
    parts = [*_records(data)]
    if len(parts) < 2 or rng.random() < 0.1:
        return corrupt_bytes(data, rng)
    at = rng.randrange(len(parts))
    match rng.randrange(10):
        case 0:
            del parts[at]
        case 1:
            parts.insert(at, rng.choice(parts))
        case 2:
            parts.append(parts.pop(at))
        case _:
            parts[at] = _changed(parts[at], rng)
    return MAGIC + b"".join(parts)


def _records(data: bytes) -> Iterator[bytes]:
    """The records behind the magic, whole ones and what is left."""
    at = len(MAGIC)
    while at < len(data):
        end = len(data)
        if at + FRAME.size <= len(data):
            end = min(end, at + FRAME.size + FRAME.unpack_from(data, at)[1])
        yield data[at:end]
        at = end


def _changed(record: bytes, rng: random.Random) -> bytes:
    if len(record) < FRAME.size:
        return corrupt_bytes(record, rng)
    opcode, content = record[0], record[FRAME.size :]
    if opcode == Opcode.CHUNK and len(content) > 40 and rng.random() < 0.7:
        content = _changed_chunk(content, rng)
    elif opcode == MARK_OPCODE:
        return _changed_mark(record, rng)
    else:
        content = corrupt_bytes(content, rng)
    return FRAME.pack(opcode, len(content)) + content


def _changed_chunk(content: bytes, rng: random.Random) -> bytes:
    """An uncompressed chunk whose body is another and whose head says so."""
    start, end, _, _, name = _CHUNK.unpack_from(content)
    body = content[_CHUNK.size + name + _U64.size :]
    inner = [*_records(MAGIC + body)]
    if inner and not name:
        at = rng.randrange(len(inner))
        inner[at] = _changed(inner[at], rng) if rng.random() < 0.7 else rng.choice(inner)
        body = b"".join(inner)
    else:
        body = corrupt_bytes(body, rng)
    head = content[_CHUNK.size : _CHUNK.size + name]
    fixed = _CHUNK.pack(start, end, len(body), zlib.crc32(body), name)
    return fixed + head + _U64.pack(len(body)) + body


def _changed_mark(mark: bytes, rng: random.Random) -> bytes:
    """A commit mark of other offsets, made with the seed of its segment."""
    seed = int.from_bytes(mark[-4:], "little") ^ zlib.crc32(mark[:-4])
    changed = corrupt_bytes(mark[:-4], rng)
    return changed + struct.pack("<I", zlib.crc32(changed) ^ seed)
