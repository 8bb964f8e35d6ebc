"""Files of class names, as `detect`, `import` and `record` read them."""

from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import read_label_file
from projections.surfaces.cli.bag_text import labels_by_number


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (b"cup\n traffic light \r\n\n\n", ["cup", "traffic light"]),
        (b"\xef\xbb\xbfcup\n\nchair", ["cup", "", "chair"]),
        (b'["a", "b"]', ["a", "b"]),
        (b' [\n"a"\n]\n', ["a"]),
        (b"[background]\ncup\n", ["[background]", "cup"]),
        (b"[background]", ["[background]"]),
        (b"", []),
    ],
)
def test_names_are_read(content: bytes, names: list[Any], tmp_path: Path) -> None:
    file = tmp_path / "labels"
    file.write_bytes(content)
    assert read_label_file(file) == names
    by_number = {str(number): name for number, name in enumerate(names) if name}
    if by_number:
        assert labels_by_number(file) == by_number
    else:
        with pytest.raises(MisuseError, match="names no class"):
            labels_by_number(file)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xff\xfe", "no UTF-8 text"),
        (b"[", "no JSON list"),
        (b"[" * 100_000, "no JSON list"),
        (b"x\n" * 600_000, "larger than 1,000,000 bytes"),
        (b"\xff" * 1_100_000, "larger than 1,000,000 bytes"),
    ],
)
def test_what_is_no_list_is_one_line(content: bytes, reason: str, tmp_path: Path) -> None:
    file = tmp_path / "labels"
    file.write_bytes(content)
    with pytest.raises(MisuseError, match=reason) as caught:
        read_label_file(file)
    assert "\n" not in str(caught.value)


def test_numbers_are_no_names(tmp_path: Path) -> None:
    (tmp_path / "labels").write_text('["a", 1]')
    with pytest.raises(MisuseError, match="not a list of names"):
        labels_by_number(tmp_path / "labels")
    with pytest.raises(MisuseError, match="check the path"):
        labels_by_number(tmp_path / "none")
    assert labels_by_number(None) == {}
