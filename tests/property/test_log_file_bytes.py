"""The bytes of a file are found as in `bytes`, across blocks and holes."""

import os
import tempfile
from pathlib import Path

from hypothesis import example, given
from hypothesis import strategies as st

from eventsrc.log.file_bytes import BLOCK_BYTES, FileBytes

PATTERN = b"\x80\x00\x00z"
HOLE = 1 << 16
EDGES = (0, HOLE, BLOCK_BYTES, BLOCK_BYTES + HOLE, 2 * BLOCK_BYTES, 2 * BLOCK_BYTES + 3 * HOLE)
PLACES = st.builds(lambda edge, by: max(0, edge + by), st.sampled_from(EDGES), st.integers(-6, 6))


@given(
    pieces=st.lists(
        st.tuples(PLACES, st.sampled_from([PATTERN, b"\x80\x00", b"z" * 9])), max_size=5
    ),
    size=PLACES,
    start=PLACES | st.just(0),
    first=PLACES,
    last=PLACES,
)
@example([(BLOCK_BYTES, PATTERN)], 2 * BLOCK_BYTES, 0, 0, 1)  # all data is behind the end
def test_it_is_like_bytes(
    pieces: list[tuple[int, bytes]], size: int, start: int, first: int, last: int
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        with path.open("wb") as file:
            for at, data in pieces:
                os.pwrite(file.fileno(), data, at)
            os.ftruncate(file.fileno(), size)
        whole = path.read_bytes()[start:]
        with path.open("rb") as file, FileBytes(file.fileno(), start) as found:
            assert len(found) == len(whole)
            assert found[first:last] == whole[first:last]
            assert found[first:] == whole[first:]
            for pattern in (PATTERN, b"z", b"\x80"):
                assert found.find(pattern) == whole.find(pattern)
                assert found.find(pattern, first) == whole.find(pattern, first)
                assert found.find(pattern, first, last) == whole.find(pattern, first, last)
                assert found.rfind(pattern) == whole.rfind(pattern)
                assert found.rfind(pattern, 0, last) == whole.rfind(pattern, 0, last)
                assert found.startswith(pattern, first) == whole.startswith(pattern, first)
