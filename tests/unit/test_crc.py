"""Our CRC-32 is the one that zlib computes, with and without ISA-L."""

import subprocess
import sys
import zlib

from hypothesis import given
from hypothesis import strategies as st

from eventsrc.base.machine import crc32


@given(st.binary(max_size=40_000), st.integers(0, 2**32 - 1))
def test_it_is_zlib_s(data: bytes, before: int) -> None:
    assert crc32(data, before) == zlib.crc32(data, before)
    assert crc32(memoryview(data)) == zlib.crc32(data)


@given(st.lists(st.binary(max_size=2_000), max_size=8))
def test_pieces_give_the_crc_of_the_whole(pieces: list[bytes]) -> None:
    crc = 0
    for piece in pieces:
        crc = crc32(piece, crc)
    assert crc == zlib.crc32(b"".join(pieces))


def test_zlib_computes_it_where_isal_is_not_installed() -> None:
    code = (
        "import sys, zlib; sys.modules['isal'] = None\n"
        "from eventsrc.base.machine import crc32\n"
        "sys.exit(0 if crc32 is zlib.crc32 else 1)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
