"""map.yaml of a map server and its image, against map_io's rule applied pixel by pixel."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from eventsrc.base.errors import MisuseError
from eventsrc.record.importers.map_yaml import MAX_YAML_BYTES, read_map_yaml
from tests.support.maps import cells, write_map_yaml
from tests.support.thorough import rounds

DRAWING = """
    #####
    #..?#
    #...#
"""


def _oracle(rgb: tuple[int, int, int], alpha: int, mode: str, negate: bool) -> int:
    """One pixel, as the rule is written; thresholds 0.65 and 0.196."""
    shade = sum(rgb) / 3 / 255
    if mode == "raw":
        value = round(shade * 255)
        return value if 0 <= value <= 100 else 255
    occupied = shade if negate else 1 - shade
    if alpha != 255:
        return 255
    if occupied > 0.65:
        return 100
    if occupied < 0.196:
        return 0
    return 255 if mode == "trinary" else round((occupied - 0.196) / (0.65 - 0.196) * 98 + 1)


def test_a_map_is_read_upright_with_all_that_the_yaml_says(tmp_path: Path) -> None:
    path = write_map_yaml(tmp_path, DRAWING, resolution=0.05, origin=[-3.5, 2, 0.1])
    read = read_map_yaml(path)
    assert np.array_equal(read.cells, cells(DRAWING))
    assert (read.map_id, read.source) == ("map", "map.yaml")
    assert (read.resolution, read.origin) == (0.05, (-3.5, 2.0, 0.1))


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [0, 1])
@pytest.mark.parametrize("kind", ["L", "RGB", "RGBA", "LA", "P", "1"])
def test_every_mode_and_kind_of_image_follows_the_rule(
    tmp_path: Path, mode: str, negate: int, kind: str
) -> None:
    rng = np.random.default_rng(5)
    rgba = rng.integers(0, 256, (9, 14, 4), np.uint8)
    rgba[::2, :, 3] = 255
    rgba[:3, :, :3] = np.arange(3 * 14).reshape(3, 14, 1) * 6  # grey, all shades
    image = Image.fromarray(rgba).convert(kind)
    image.save(tmp_path / "own.png")
    path = write_map_yaml(tmp_path, DRAWING, image="own.png", mode=mode, negate=negate)
    pixels = np.asarray(image.convert("RGBA"))
    expected = [
        [_oracle(tuple(p[:3]), p[3], mode, bool(negate)) for p in row] for row in pixels.tolist()
    ]  # type: ignore[arg-type]
    assert read_map_yaml(path).cells[::-1].tolist() == expected


def test_pgm_is_read_as_text_binary_and_with_16_bits(tmp_path: Path) -> None:
    shades = [[0, 254, 205], [254, 0, 254]]
    flat = [v for row in shades for v in row]
    (tmp_path / "text.pgm").write_text("P2\n# a comment\n3 2\n255\n" + " ".join(map(str, flat)))
    (tmp_path / "binary.pgm").write_bytes(b"P5 3 2 255\n" + bytes(flat))
    deep = b"".join((v * 257).to_bytes(2, "big") for v in flat)
    (tmp_path / "deep.pgm").write_bytes(b"P5 3 2 65535\n" + deep)
    Image.fromarray(np.array(shades, np.uint16) * 257).save(tmp_path / "deep.png")
    for name in ("text.pgm", "binary.pgm", "deep.pgm", "deep.png"):
        read = read_map_yaml(write_map_yaml(tmp_path, DRAWING, image=name))
        assert np.array_equal(read.cells, cells("#.? .#.")), name


def test_the_image_is_beside_the_yaml_or_where_its_absolute_path_says(tmp_path: Path) -> None:
    folder, other = tmp_path / "a", tmp_path / "b"
    folder.mkdir()
    other.mkdir()
    write_map_yaml(other, DRAWING)
    for name in ("../b/map.png", str(other / "map.png")):
        assert read_map_yaml(write_map_yaml(folder, "..", image=name)).width == 5


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"image": None}, "map.yaml: image: Field required"),
        ({"image": ""}, "map.yaml: image: "),
        ({"image": "none.png"}, "none.png: No such file or directory; check the path"),
        ({"image": "a\0b"}, "embedded null"),
        ({"image": "."}, "Is a directory; check the path"),
        ({"image": "map.yaml"}, "map.yaml: it is no PNG or PGM image; give a PGM or PNG image"),
        ({"resolution": 0}, "map.yaml: resolution: Input should be greater than or equal to 0.001"),
        ({"resolution": "fine"}, "map.yaml: resolution: Input should be a valid number"),
        ({"origin": [0, 0]}, "map.yaml: origin.2: Field required"),
        ({"negate": 2}, "map.yaml: negate: Input should be less than or equal to 1"),
        ({"occupied_thresh": 1.5}, "map.yaml: occupied_thresh: Input should be less than or equal"),
        ({"occupied_thresh": 0.1}, "map.yaml: free_thresh 0.196 is above occupied_thresh 0.1"),
        ({"mode": "colour"}, "map.yaml: mode: Input should be 'trinary', 'scale' or 'raw'"),
        ({"image": None}, "image: Field required; add the name of a PGM or PNG file"),
        ({"resolution": 0}, "0.001 (got 0 in line 3); give the side of a pixel in metres, such as"),
        ({"resolution": "fine"}, "(got 'fine' in line 3); give the side of a pixel"),
        ({"origin": [0, 0]}, "Field required (got [0, 0] in line 4); give [x, y, yaw] of the"),
        ({"origin": [0, "a", 0]}, "origin.1: Input should be a valid number, unable to parse"),
        ({"origin": [0, "a", 0]}, "(got 'a' in line 4); give [x, y, yaw] of the"),
        ({"negate": 2}, "(got 2 in line 5); give 0, or 1 where white is occupied"),
        ({"occupied_thresh": 1.5}, "(got 1.5 in line 6); give a share from 0 to 1, such as 0.65"),
        ({"occupied_thresh": 0.1}, "; lower the one or raise the other (often 0.25 and 0.65)"),
        ({"mode": "x" * 500}, "xxx... in line 2); give trinary, scale or raw"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(
    tmp_path: Path, fields: dict[str, Any], reason: str
) -> None:
    path = write_map_yaml(tmp_path, DRAWING, **fields)
    with pytest.raises(MisuseError) as caught:
        read_map_yaml(path)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "no map.yaml"),
        (b"- a\n- b\n", "no map.yaml"),
        (b"- a\n- b\n", "but is ['a', 'b']; give a map server's map.yaml"),
        (b"image: [", "no YAML: while parsing"),
        (b"\xff\xfe\xfd", "no YAML: "),
        (b"image: \x07", "no YAML: "),
        (b"resolution: .nan\nimage: a\norigin: [0,0,0]", "resolution: Input should be a finite"),
        (b"resolution: " + b"9" * 5000, "no YAML: "),
        (b"[" * rounds(20_000, 1_000), "no YAML: "),
        (
            b"x" * (MAX_YAML_BYTES + 1),
            "larger than 65,536 bytes, too much for such a file; check the path",
        ),
        (b"!!python/object/apply:os.system ['true']", "no YAML: could not determine"),
    ],
)
@pytest.mark.seconds
def test_hostile_yaml_is_one_line(tmp_path: Path, content: bytes, reason: str) -> None:
    path = tmp_path / "map.yaml"
    path.write_bytes(content)
    with pytest.raises(MisuseError) as caught:
        read_map_yaml(path)
    assert reason in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_billion_laughs_take_no_memory(tmp_path: Path) -> None:
    laughs = "a0: &a0 [ha, ha]\n" + "".join(
        f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}, *a{n - 1}, *a{n - 1}]\n" for n in range(1, 60)
    )
    (tmp_path / "map.yaml").write_text(laughs + "image: *a59\n")
    with pytest.raises(MisuseError, match="line 2: an alias, "):
        read_map_yaml(tmp_path / "map.yaml")


def test_an_image_larger_than_the_limits_is_refused_unread(tmp_path: Path) -> None:
    for head in (b"P5 10001 1 255\n", b"P5 5000 5000 255\n", b"P5 99999 99999 255\n"):
        (tmp_path / "large.pgm").write_bytes(head)
        path = write_map_yaml(tmp_path, DRAWING, image="large.pgm")
        with pytest.raises(MisuseError) as caught:
            read_map_yaml(path)
        said = str(caught.value)
        assert "a side may have 10,000, all 16,000,000" in said or "exceeds limit" in said


def test_an_image_cut_short_is_refused(tmp_path: Path) -> None:
    path = write_map_yaml(tmp_path, DRAWING)
    whole = (tmp_path / "map.png").read_bytes()
    refused = 0
    for size in range(
        len(whole) - 24
    ):  # behind that are checksums and a chunk that says it is the last
        (tmp_path / "map.png").write_bytes(whole[:size])
        with pytest.raises(MisuseError, match="give a PGM or PNG image"):
            read_map_yaml(path)
        refused += 1
    assert refused > 50
