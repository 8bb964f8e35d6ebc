"""Occupancy maps as events: what is encoded comes back, and what is wrong is named in one line."""

import base64
import json
from typing import Any

import numpy as np
import pytest

from eventsrc.envelope.grey_images import encode_png
from eventsrc.envelope.occupancy_map import (
    MAX_MAP_BYTES,
    MAX_MAP_CELLS,
    MAX_MAP_SIDE,
    InvalidMap,
    OccupancyMap,
    decode_map,
    read_map_head,
)
from tests.support.maps import drawn_map

HOUSE = drawn_map("##### #..?# #...#", 0.05, (-1.0, 2.5, 0.3), "house")


def _document(**fields: Any) -> bytes:
    return json.dumps({**json.loads(HOUSE.encode()), **fields}).encode()


def _png(pixels: Any) -> str:
    return base64.b64encode(encode_png(np.array(pixels, np.uint8))).decode()


def _same(a: OccupancyMap, b: OccupancyMap) -> bool:
    heads = [(m.map_id, m.resolution, m.origin, m.source) for m in (a, b)]
    return heads[0] == heads[1] and np.array_equal(a.cells, b.cells)


def test_a_map_comes_back_from_its_event() -> None:
    assert _same(decode_map(HOUSE.encode()), HOUSE)
    anonymous = OccupancyMap(None, 0.1, (0.0, 0.0, 0.0), "tb/map", np.array([[7]], np.uint8))
    assert _same(decode_map(anonymous.encode()), anonymous)
    assert "map_id" not in json.loads(anonymous.encode())


def test_a_map_may_name_its_floor() -> None:
    upstairs = OccupancyMap("house", 0.1, (0.0, 0.0, 0.0), "drawing", HOUSE.cells, "1st")
    assert json.loads(upstairs.encode())["floor"] == decode_map(upstairs.encode()).floor == "1st"
    assert decode_map(_document(floor=2)).floor == "2"
    assert decode_map(_document(floor=None)).floor is decode_map(HOUSE.encode()).floor is None
    assert "floor" not in json.loads(HOUSE.encode())


def test_the_image_shows_the_building_upright() -> None:
    """The last row of the PNG is the row of the origin, as in the image of a map server."""
    from PIL import Image

    raw = base64.b64decode(json.loads(HOUSE.encode())["png"])
    import io

    shown = np.asarray(Image.open(io.BytesIO(raw)))
    assert shown.tolist() == [[100] * 5, [100, 0, 0, 255, 100], [100, 0, 0, 0, 100]]
    assert HOUSE.cells[0].tolist() == [100, 0, 0, 0, 100]


def test_the_head_is_read_without_the_image() -> None:
    head = read_map_head(_document(png="!"))
    assert (head.map_id, head.width, head.height, head.resolution) == ("house", 5, 3, 0.05)


def test_the_digest_is_of_the_building_and_not_of_names() -> None:
    same = OccupancyMap("other", HOUSE.resolution, HOUSE.origin, "elsewhere", HOUSE.cells.copy())
    assert same.digest() == HOUSE.digest()
    others = [
        OccupancyMap("house", 0.1, HOUSE.origin, "drawing", HOUSE.cells),
        OccupancyMap("house", 0.05, (-1.0, 2.5, 0.0), "drawing", HOUSE.cells),
        OccupancyMap("house", 0.05, HOUSE.origin, "drawing", HOUSE.cells[::-1]),
        OccupancyMap("house", 0.05, HOUSE.origin, "drawing", HOUSE.cells.reshape(5, 3)),
    ]
    assert len({HOUSE.digest(), *(m.digest() for m in others)}) == 5


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"junk", "the map: Invalid JSON"),
        (b"[]", "the map: Input should be an object"),
        (b"{}", "resolution: required field is missing"),
        (_document(resolution=0), "resolution: Input should be greater than or equal to 0.001 (g"),
        (_document(resolution="0.1"), "resolution: Input should be a valid number"),
        (_document(origin=[0, 0]), "origin.2: required field is missing"),
        (_document(origin=[0, 2e7, 0]), "origin.1: Input should be less than or equal to 10000000"),
        (_document(origin=[0, 0, 8.0]), "origin.2: Input should be less than or equal to 7 (got 8"),
        (_document(width=10_001), "width: Input should be less than or equal to 10000 (got 10001)"),
        (_document(width=-1), "width: Input should be greater than or equal to 1 (got -1)"),
        (_document(width=5.5), "width: Input should be a valid integer"),
        (_document(width=9_000, height=9_000), "it has 9,000 × 9,000 cells, more than 16,000,000"),
        (_document(source=""), "source: is empty"),
        (_document(map_id="a\x00b"), "map_id: has the control character U+0000 at index 1"),
        (_document(floor=""), "floor: is no floor; give an integer or a text of 1 to 256"),
        (_document(floor=1.5), "floor: is no floor"),
        (_document(png="#"), "png: is not base64"),
        (_document(png=""), "png: it is no PNG image"),
        (_document(width=6), "png: it has 5 × 3 pixels, not 6 × 3"),
        (_document(png=_png([[1] * 5, [101] * 5, [1] * 5])), "png: it has other values than allo"),
        (_document(png=_png(np.zeros((3, 5, 3)))), "png: it is a PNG of mode RGB, not 8-bit grey"),
        (b" " * (MAX_MAP_BYTES + 1), "it has 33,554,433 bytes, more than 33,554,432"),
        (_document().replace(b"0.05", b"NaN"), "resolution: Input should be a finite number"),
    ],
)
def test_what_is_no_map_is_refused_with_the_field_and_the_rule(payload: bytes, reason: str) -> None:
    with pytest.raises(InvalidMap) as caught:
        decode_map(payload)
    assert str(caught.value).startswith(reason)
    assert "\n" not in str(caught.value)


def test_an_event_is_never_made_that_could_not_be_read() -> None:
    def made(cells: Any, resolution: float = 0.1, x: float = 0.0) -> bytes:
        return OccupancyMap(None, resolution, (x, 0.0, 0.0), "s", cells).encode()

    one = np.zeros((1, 1), np.uint8)
    with pytest.raises(InvalidMap, match="the value 101: 0 is free"):
        made(one + 101)
    with pytest.raises(InvalidMap, match="NaN or infinite"):
        made(one, float("nan"))
    with pytest.raises(InvalidMap, match="NaN or infinite"):
        made(one, 0.1, float("inf"))
    with pytest.raises(InvalidMap, match=r"resolution: .* 10 "):
        made(one, 11.0)
    with pytest.raises(InvalidMap, match="a side has 1 to 10,000"):
        made(np.zeros((MAX_MAP_SIDE + 1, 1), np.uint8))
    with pytest.raises(InvalidMap, match="0 × 5 cells"):
        made(np.zeros((5, 0), np.uint8))
    with pytest.raises(InvalidMap, match="more than 16,000,000; make the cells larger"):
        made(np.zeros((4001, 4000), np.uint8))


@pytest.mark.seconds
@pytest.mark.slow
def test_a_map_of_the_largest_size_goes_through() -> None:
    noise = np.random.default_rng(0).integers(0, 101, (4000, 4000), np.uint8)
    assert noise.size == MAX_MAP_CELLS
    encoded = OccupancyMap(None, 0.05, (0.0, 0.0, 0.0), "s", noise).encode()
    assert len(encoded) < MAX_MAP_BYTES
    assert np.array_equal(decode_map(encoded).cells, noise)


def test_a_png_that_says_it_is_huge_is_refused_before_it_is_decoded() -> None:
    raw = bytearray(encode_png(np.zeros((3, 5), np.uint8)))
    raw[16:24] = (50_000).to_bytes(4, "big") * 2
    import zlib

    raw[29:33] = zlib.crc32(bytes(raw[12:29])).to_bytes(4, "big")
    with pytest.raises(InvalidMap) as caught:
        decode_map(_document(png=base64.b64encode(bytes(raw)).decode()))
    assert str(caught.value).startswith(
        "png: it cannot be read: Image size"
    ) or "pixels, not" in str(caught.value)
