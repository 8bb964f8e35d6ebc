"""Damaged images raise BadImage and nothing else, whatever bytes were changed."""

import io
import warnings

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from eventsrc.envelope.grey_images import BadImage, decode_grey_png, decode_rgba, encode_png


def _saved(mode: str, kind: str) -> bytes:
    out = io.BytesIO()
    pixels = np.arange(12 * 9, dtype=np.uint8).reshape(9, 12)
    Image.fromarray(pixels).convert(mode).save(out, kind)
    return out.getvalue()


WHOLE = [
    encode_png(np.arange(12 * 9, dtype=np.uint8).reshape(9, 12)),
    _saved("P", "PNG"),
    _saved("RGBA", "PNG"),
    _saved("1", "PNG"),
    _saved("I;16", "PNG"),
    _saved("L", "PPM"),
    b"P2\n3 2\n255\n1 2 3 4 5 6\n",
    b"P5 3 2 65535\n" + bytes(12),
    b"P1\n3 2\n1 0 1 0 1 0\n",
]


@given(
    st.sampled_from(WHOLE),
    st.lists(st.tuples(st.floats(0, 1), st.binary(max_size=4)), max_size=4),
    st.floats(0, 1),
)
def test_a_changed_image_is_read_or_refused(
    whole: bytes, changes: list[tuple[float, bytes]], kept: float
) -> None:
    data = bytearray(whole)
    for place, content in changes:
        at = int(place * len(data))
        data[at : at + len(content)] = content
    cut = bytes(data[: max(1, int(kept * len(data)))] if kept < 0.3 else data)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for read in (
            lambda: decode_rgba(cut, 1000, 100_000),
            lambda: decode_grey_png(cut, 12, 9),
        ):
            try:
                pixels = read()
            except BadImage:
                continue
            assert pixels.dtype == np.uint8
            assert pixels.shape[0] * pixels.shape[1] <= 100_000


@given(st.binary(max_size=200), st.sampled_from([b"\x89PNG\r\n\x1a\n", b"P5 ", b"P2\n", b"P6 "]))
def test_any_bytes_behind_a_head_are_read_or_refused(rest: bytes, head: bytes) -> None:
    try:
        pixels = decode_rgba(head + rest, 1000, 100_000)
    except BadImage:
        return
    assert pixels.shape[2] == 4
