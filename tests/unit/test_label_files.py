"""Files of class names, as `detect`, `import` and `record` read them."""

from pathlib import Path
from typing import Any

import pytest

from eventsrc.base.errors import MisuseError
from eventsrc.base.user_files import read_label_file
from eventsrc.record.importers.map_yaml import read_labels


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
        assert read_labels(file) == by_number
    else:
        with pytest.raises(MisuseError, match="names no class"):
            read_labels(file)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\xff\xfe", "no UTF-8 text"),
        (b"[", "no JSON list"),
        (b"[" * 100_000, "no JSON list"),
        (b"x\n" * 600_000, "larger than 1,000,000 bytes, too much for such a file; check the path"),
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
        read_labels(tmp_path / "labels")
    with pytest.raises(MisuseError, match="give a file with the names of cl"):
        read_labels(tmp_path / "none")


COCO = '[{"id": 62, "name": "chair"}, {"id": 0, "name": "person"}]'


@pytest.mark.parametrize(
    ("name", "content", "labels"),
    [
        ("labels.json", '{"17": "chair", "0": "person", "3": ""}', {"17": "chair", "0": "person"}),
        ("labels.json", '["person", "chair"]', {"0": "person", "1": "chair"}),
        ("labels.txt", '\ufeff {"17": "chair"}', {"17": "chair"}),
        ("config.json", '{"id2label": {"17": "chair"}, "x": 1}', {"17": "chair"}),
        ("coco.json", COCO, {"62": "chair", "0": "person"}),
        ("coco.json", f'{{"categories": {COCO}, "images": []}}', {"62": "chair", "0": "person"}),
        ("labels.yaml", "17: chair\n'a b': cup\n", {"17": "chair", "a b": "cup"}),
        ("data.YML", "path: x\nnc: 2\nnames: [cup, chair]\n", {"0": "cup", "1": "chair"}),
        ("data.yaml", "names:\n  0: cup\n  7: chair\n", {"0": "cup", "7": "chair"}),
        ("names", "cup\n\nchair\n", {"0": "cup", "2": "chair"}),
    ],
)
def test_labels_are_read(name: str, content: str, labels: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / name).write_text(content, "utf-8")
    assert read_labels(tmp_path / name) == labels


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.json", '{"17": 3}', "not a list of names: 3 is the name of label '17'"),
        ("a.json", '{"17": null}', "not a list of names"),
        ("a.json", '{"17": "a"', "give names by label as JSON"),
        ("a.json", '[{"id": 1, "name": "a"}, {"id": 1, "name": "b"}]', "label 1 has two names"),
        ("a.json", '[{"id": 1.5, "name": "a"}]', "1.5 is no label"),
        ("a.json", "[[1, 2]]", "not a list of names"),
        ("a.json", '{"names": {}}', "names no class"),
        ("a.yaml", "- &a x\n- *a\n", "an alias"),
        ("a.yaml", "just text", "not a list of names"),
        ("a.yaml", "17: !!python/object:os.system x", "give names by label as YAML"),
        ("a.yaml", "true: x", "True is no label"),
        ("a.yaml", "x: " + "[" * 200 + "]" * 200, "give names by label as YAML"),
        ("a.json", '["' + "x" * 1_000_000, "too much for such a file; give a file with the names"),
        ("none.yaml", None, "give a file with the names of classes"),
    ],
)
def test_what_names_no_labels_says_why(
    name: str, content: str | None, reason: str, tmp_path: Path
) -> None:
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(MisuseError) as caught:
        read_labels(tmp_path / name)
    assert reason in str(caught.value)
    assert str(caught.value).startswith(f"--labels {tmp_path / name}: ")
