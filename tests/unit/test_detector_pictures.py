"""Pictures as bytes: sizes, ends, streams, damage; and what is decoded from them."""

import random
import struct
import zlib

import numpy as np
import pytest

from eventsrc.adapters.detector.picture import PictureError, check_picture
from eventsrc.adapters.detector.vision import decode, encode_jpeg, fitted
from eventsrc.envelope.grey_images import encode_png


def _noise(
    width: int, height: int, seed: int = 0
) -> "np.ndarray[tuple[int, ...], np.dtype[np.uint8]]":
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8)


JPEG = encode_jpeg(_noise(64, 40))
PNG = encode_png(_noise(30, 20)[:, :, 0])


def test_a_picture_is_decoded_to_its_size() -> None:
    assert decode(JPEG).shape == (40, 64, 3)
    assert decode(PNG).shape == (20, 30, 3)


def test_colours_come_out_as_blue_green_red() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[:, :, 2] = 255
    assert decode(encode_jpeg(red))[8, 8].tolist() == pytest.approx([0, 0, 254], abs=2)


@pytest.mark.parametrize("whole", [JPEG, PNG], ids=["jpeg", "png"])
def test_every_cut_is_refused(whole: bytes) -> None:
    for length in range(len(whole)):
        with pytest.raises(PictureError):
            check_picture(whole[:length])
    check_picture(whole + b"behind the end")


def test_damage_inside_is_found_and_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    found = 0
    rng = random.Random(4)
    start = JPEG.index(b"\xff\xda") + 20
    for _ in range(60):
        damaged = bytearray(JPEG)
        for _ in range(4):
            damaged[rng.randrange(start, len(JPEG) - 2)] = rng.choice(
                (0xFF, 0xD9, rng.randrange(256))
            )
        try:
            assert decode(bytes(damaged)).shape == (40, 64, 3)
        except PictureError:
            found += 1
    assert found > 20
    assert capfd.readouterr().err == ""


def test_what_cameras_put_behind_the_last_pixel_is_no_damage(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """As webcams do that compress in hardware; of more bytes than that, pixels may be missing."""
    for count in range(16):
        padded = JPEG[:-2] + b"\x55" * count + JPEG[-2:]
        assert np.array_equal(decode(padded), decode(JPEG)), count
    with pytest.raises(PictureError, match="extraneous bytes"):
        decode(JPEG[:-2] + b"\x55" * 100 + JPEG[-2:])
    assert capfd.readouterr().err == ""


def test_a_damaged_png_is_found_by_its_crc() -> None:
    for at in range(8, len(PNG) - 12):
        damaged = bytearray(PNG)
        damaged[at] ^= 1
        with pytest.raises(PictureError):
            decode(bytes(damaged))


def test_what_others_print_meanwhile_goes_on(capfd: pytest.CaptureFixture[str]) -> None:
    import os

    from eventsrc.adapters.detector import vision

    with vision._decoder_messages() as messages:
        os.write(2, b"a line of another thread\n")
    assert messages == []
    assert capfd.readouterr().err == "a line of another thread\n"


def _png_of_size(width: int, height: int) -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunks = [head, b"IDAT" + zlib.compress(b"\0" * 100), b"IEND"]
    parts = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "it is empty"),
        (b"GIF89a....", "neither JPEG nor PNG"),
        (b"RIFF____WEBP", "neither JPEG nor PNG"),
        (_png_of_size(100_000, 100_000), "100,000 × 100,000 pixels"),
        (_png_of_size(0, 5), "gives no size"),
        (_png_of_size(50, 50), "cannot be decoded|damaged"),
        (b"\xff\xd8\xff\xd9", "gives no size"),
    ],
)
def test_what_is_no_picture_is_one_line(data: bytes, reason: str) -> None:
    with pytest.raises(PictureError, match=reason):
        decode(data)


@pytest.mark.parametrize("size", [(1, 1), (1, 300), (300, 1), (3, 200), (640, 400)])
def test_a_crop_of_any_shape_is_fitted(size: tuple[int, int]) -> None:
    pixels = _noise(*size)
    for fit in ("crop", "stretch", "pad"):
        assert fitted(pixels, (32, 24), fit, cubic=True).shape == (24, 32, 3)


def test_how_a_crop_is_fitted() -> None:
    half = np.zeros((100, 400, 3), np.uint8)
    half[:, :200] = 200
    stretched = fitted(half, (40, 40), "stretch", cubic=False)
    assert stretched[20, 2, 0] == 200
    assert stretched[20, 37, 0] == 0
    cropped = fitted(half, (40, 40), "crop", cubic=False)
    assert cropped[20, 2, 0] == 200
    assert cropped[20, 37, 0] == 0
    padded = fitted(half, (40, 40), "pad", cubic=False)
    assert padded[2, 2, 0] == 0
    assert padded[20, 2, 0] == 200


def test_a_picture_over_64_mib_is_not_taken() -> None:
    with pytest.raises(PictureError, match=r"67,108,864|64 MiB"):
        decode(JPEG + bytes(64 * 1024 * 1024))
