"""Files and documents that a person names: whatever they are, a fault with a reason, and soon."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eventsrc.adapters.detector.vision_models import read_preparation
from eventsrc.base.errors import MapfoldError, MisuseError
from eventsrc.base.user_files import MAX_DEPTH, FileFault, parse_json, read_file, read_label_file
from eventsrc.envelope.trajectory import read_trajectory
from eventsrc.record.importers.map_yaml import read_map_yaml
from projections.adapters.fleet.sites import find_sites
from projections.fold.map_errors import QuestionError, SettingsError
from projections.localize.evaluate.truth import read_truth
from projections.localize.relocalize import parse_question
from projections.surfaces.cli.folded_log import settings_from
from projections.surfaces.cli.options import question_from

GOOD = """\
image: map.pgm
resolution: 0.05
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.25
"""
DIGITS = "9" * 60_000
YAML = {
    "hexadecimal digits": "resolution: 0x" + "f" * 60_000,
    "binary digits": "resolution: 0b" + "1" * 60_000,
    "digits": "resolution: " + DIGITS,
    "a whole number that no float is as large as": "resolution: 0x" + "f" * 300,
    "base 60": "resolution: " + "59:" * 20_000 + "59",
    "a fraction to base 60": "resolution: " + "59:" * 20_000 + "59.5",
    "an alias of itself": "resolution: &a [*a]",
    "an alias": "origin: &a [0.0, 0.0, 0.0]\nresolution: *a",
    "lists of lists": "resolution: " + "[" * 30_000 + "]" * 30_000,
    "no number": "resolution: !!int ''",
    "no time": "resolution: !!timestamp x",
    "no truth": "resolution: !!bool x",
    "no base64": "resolution: !!binary '\u20ac'",
    "a day that is none": "resolution: 2001-99-99",
    "infinity": "resolution: .inf",
    "a list for a name": "? [a]\n: 1",
    "a tag of Python": "resolution: !!python/object/apply:os.abort []",
}


@pytest.mark.parametrize("text", YAML.values(), ids=YAML)
def test_yaml_of_any_content_is_a_map_or_misuse(text: str, tmp_path: Path) -> None:
    file = tmp_path / "map.yaml"
    file.write_text(GOOD + text + "\n")
    with pytest.raises(MisuseError, match=r"map\.yaml"):
        read_map_yaml(file)


_SCALARS = st.sampled_from(["0x", "0b1", "59", ":", ".5", "e9", "-", "_", "&a ", "*a", "!!int "])
_MARKS = st.sampled_from(["[", "]", "{", "}", ",", ": ", "? ", "\n", "- ", "'", '"', "|", "<<: "])


@given(st.lists(_SCALARS | _MARKS | st.text(max_size=3), max_size=30).map("".join))
def test_no_yaml_raises_anything_else(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    file = tmp_path_factory.getbasetemp() / "any.yaml"
    file.write_text(GOOD + "resolution: " + text, "utf-8", "surrogatepass")
    with pytest.raises(MisuseError):
        read_map_yaml(file)


JSON = {
    "digits": DIGITS,
    "a whole number that no float is as large as": "9" * 400,
    "lists of lists": "[" * 100_000,
    "lists of some lists": "[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1),
    "no text": "\udcff",
    "nothing": "",
}


@pytest.mark.parametrize("text", JSON.values(), ids=JSON)
def test_json_that_is_too_much_is_a_fault_everywhere(text: str, tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    document = f'{{"crops": {text}, "eps_m": {text}, "keyframe_id": {text}}}'
    payload = document.encode("utf-8", "surrogateescape")
    file.write_bytes(payload)
    (tmp_path / "labels").write_bytes(f'["a", {text}]'.encode("utf-8", "surrogateescape"))
    with pytest.raises(FileFault):
        parse_json(payload)
    with pytest.raises(SettingsError):
        settings_from(file, None)
    with pytest.raises(QuestionError):
        parse_question(payload)
    with pytest.raises(MisuseError):
        read_trajectory(file)
    with pytest.raises(MisuseError):
        read_truth([file])
    with pytest.raises(MisuseError):
        read_label_file(tmp_path / "labels")
    with pytest.raises(MisuseError):
        read_preparation(file)


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    )
)
def test_any_other_json_is_what_json_says(document: Any) -> None:
    text = json.dumps(document)
    assert parse_json(text) == parse_json(text.encode()) == document


READERS: dict[str, Callable[[Path], object]] = {
    "map": read_map_yaml,
    "settings": lambda path: settings_from(path, None),
    "question": lambda path: question_from(str(path)),
    "trajectory": read_trajectory,
    "truth": lambda path: read_truth([path]),
    "labels": read_label_file,
    "preparation": read_preparation,
    "sites": lambda path: find_sites(path, lambda _: None),
    "image": lambda path: read_map_yaml(_map_of(path)),
}


def _map_of(image: Path) -> Path:
    file = image.with_name("map.yaml")
    file.write_text(GOOD.replace("map.pgm", image.name))
    return file


@pytest.mark.parametrize("reader", READERS)
def test_a_fifo_or_a_device_is_refused_and_blocks_nothing(reader: str, tmp_path: Path) -> None:
    fifo, device = tmp_path / "fifo.json", tmp_path / "device.json"
    os.mkfifo(fifo)
    device.symlink_to("/dev/zero")
    for path in (fifo, device):
        with pytest.raises(MapfoldError, match=r"not a regular file|Not a directory"):
            READERS[reader](path)


def test_a_file_over_its_bound_is_not_read_whole(tmp_path: Path) -> None:
    file = tmp_path / "large"
    with file.open("wb") as sparse:
        sparse.truncate(10**12)
    with pytest.raises(FileFault, match="larger than 1,000 bytes"):
        read_file(file, 1_000)
    for reader, read in READERS.items():
        large = tmp_path / f"{reader}.json"
        with large.open("wb") as sparse:
            sparse.truncate(10**10)
        with pytest.raises(MapfoldError):
            read(large)
