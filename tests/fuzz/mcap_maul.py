"""Damage to an MCAP file below its checksums: a record is changed and its CRC made right again."""

import random
import struct
import zlib
from collections.abc import Iterator

from mcap.opcode import Opcode

from eventsrc.log.mcap_records import FRAME, MAGIC, MARK_OPCODE
from tests.attack.json_maul import maul_bytes

_CHUNK = struct.Struct("<QQQII")
_U64 = struct.Struct("<Q")


def maul_mcap(data: bytes, chance: random.Random) -> bytes:
    """One record is changed, doubled, dropped or moved; or the file as bytes, one time in ten."""
    parts = [*_records(data)]
    if len(parts) < 2 or chance.random() < 0.1:
        return maul_bytes(data, chance)
    at = chance.randrange(len(parts))
    match chance.randrange(10):
        case 0:
            del parts[at]
        case 1:
            parts.insert(at, chance.choice(parts))
        case 2:
            parts.append(parts.pop(at))
        case _:
            parts[at] = _changed(parts[at], chance)
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


def _changed(record: bytes, chance: random.Random) -> bytes:
    if len(record) < FRAME.size:
        return maul_bytes(record, chance)
    opcode, content = record[0], record[FRAME.size :]
    if opcode == Opcode.CHUNK and len(content) > 40 and chance.random() < 0.7:
        content = _changed_chunk(content, chance)
    elif opcode == MARK_OPCODE:
        return _changed_mark(record, chance)
    else:
        content = maul_bytes(content, chance)
    return FRAME.pack(opcode, len(content)) + content


def _changed_chunk(content: bytes, chance: random.Random) -> bytes:
    """An uncompressed chunk whose body is another and whose head says so."""
    start, end, _, _, name = _CHUNK.unpack_from(content)
    body = content[_CHUNK.size + name + _U64.size :]
    inner = [*_records(MAGIC + body)]
    if inner and not name:
        at = chance.randrange(len(inner))
        inner[at] = _changed(inner[at], chance) if chance.random() < 0.7 else chance.choice(inner)
        body = b"".join(inner)
    else:
        body = maul_bytes(body, chance)
    head = content[_CHUNK.size : _CHUNK.size + name]
    fixed = _CHUNK.pack(start, end, len(body), zlib.crc32(body), name)
    return fixed + head + _U64.pack(len(body)) + body


def _changed_mark(mark: bytes, chance: random.Random) -> bytes:
    """A commit mark of other offsets, made with the seed of its segment."""
    seed = int.from_bytes(mark[-4:], "little") ^ zlib.crc32(mark[:-4])
    changed = maul_bytes(mark[:-4], chance)
    return changed + struct.pack("<I", zlib.crc32(changed) ^ seed)
