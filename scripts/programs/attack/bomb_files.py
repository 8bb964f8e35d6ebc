"""Write decompression bombs and other files that unfold to far more than their size."""

import gzip
import json
import struct
from pathlib import Path

import zstandard
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Header, Schema

from eventsrc.log.mcap_records import FRAME, MAGIC, encode
from tests.support.envelopes import envelope

_CHUNK = struct.Struct("<BQQQQII")
_PIECE = bytes(16 * 1024 * 1024)


def zstd_chunk(size: int, said: int | None = None) -> bytes:
    """A chunk record of ``size`` zeros, compressed; its head may say another size."""
    compressor = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    parts = [compressor.compress(_PIECE[: min(size - at, len(_PIECE))]) for at in _pieces(size)]
    data = b"".join([*parts, compressor.flush()])
    length = _CHUNK.size - FRAME.size + 4 + 8 + len(data)
    head = _CHUNK.pack(Opcode.CHUNK, length, 0, 0, size if said is None else said, 0, 4)
    return head + b"zstd" + struct.pack("<Q", len(data)) + data


def mcap_with(path: Path, record: bytes) -> None:
    """A whole MCAP file around one record."""
    head = MAGIC + encode(Header(profile="", library="bomb"))
    end = encode(DataEnd(data_section_crc=0))
    footer = encode(Footer(summary_start=0, summary_offset_start=0, summary_crc=0))
    path.write_bytes(head + record + end + footer + MAGIC)


def mcap_with_large_message(path: Path, size: int) -> None:
    """An MCAP file with one message of ``size`` bytes, an envelope but for its length."""
    head = json.dumps(envelope(1, run_id="large")).encode()[:-1] + b', "x": "'
    with path.open("wb") as file:
        file.write(MAGIC + encode(Header(profile="", library="bomb")))
        file.write(encode(Schema(id=1, name="s", encoding="jsonschema", data=b"{}")))
        channel = Channel(
            id=1, topic="tb/detections", message_encoding="json", metadata={}, schema_id=1
        )
        file.write(encode(channel))
        file.write(FRAME.pack(Opcode.MESSAGE, 22 + size) + struct.pack("<HIQQ", 1, 0, 1, 1) + head)
        left = size - len(head) - 2
        for at in _pieces(left):
            file.write(b"y" * min(left - at, len(_PIECE)))
        file.write(b'"}' + encode(DataEnd(data_section_crc=0)))
        file.write(encode(Footer(summary_start=0, summary_offset_start=0, summary_crc=0)) + MAGIC)


def gzip_line(path: Path, size: int) -> None:
    """A compressed file of one line that does not end."""
    with gzip.open(path, "wb", compresslevel=1) as file:
        for at in _pieces(size):
            file.write(_PIECE[: min(size - at, len(_PIECE))])


def _pieces(size: int) -> range:
    return range(0, size, len(_PIECE))
