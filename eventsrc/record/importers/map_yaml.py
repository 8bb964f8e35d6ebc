"""YAML beside a robot's data: the map.yaml of a map server (Nav2, ROS 1), read with its image as an
occupancy map; and names of classes.

``mode`` says how a pixel becomes a cell, as in Nav2's map_io. With p the mean of red, green and
blue from 0 (black) to 1, a pixel is occupied by 1 - p, by p if ``negate`` is set:

``trinary``  occupied above ``occupied_thresh``, free below ``free_thresh``, else unknown
``scale``    the same, but between the two thresholds 1 to 99 in proportion
``raw``      the pixel's own value where it is 0 to 100, else unknown

A pixel that is not opaque is unknown, except with ``raw``; with ``trinary`` Nav2 averages its alpha
with the colours instead.

Classes are named by label, which is what a detector writes as the class, often a number. A file of
JSON, or of YAML where its name ends so, is an object of names by label, a list of names from label
0 on, a list of objects with the label and the name of a class, such as COCO's categories, or an
object that has one of these in ``names``, ``class_names``, ``categories``, ``id2label`` or
``labels``. Any other file has a name in each line, the first that of label 0.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from eventsrc.base import user_files
from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, parse_json, read_file, read_label_file
from eventsrc.envelope import occupancy_map
from eventsrc.envelope.grey_images import BadImage, decode_rgba
from eventsrc.envelope.ingest import abbreviate
from eventsrc.envelope.model import Position, describe_error

MAX_YAML_BYTES = 64 * 1024
MAX_IMAGE_BYTES = 128 * 1024 * 1024
_OPAQUE = 255
_WHITE = 3 * 255
_Share = Annotated[float, Field(ge=0.0, le=1.0)]


class _MapFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    image: Annotated[str, Field(min_length=1)]
    resolution: occupancy_map.Resolution
    origin: tuple[Position, Position, occupancy_map.MapYaw]
    negate: Annotated[int, Field(ge=0, le=1)]
    occupied_thresh: _Share
    free_thresh: _Share
    mode: Literal["trinary", "scale", "raw"] = "trinary"


def read_map_yaml(path: Path, floor: str | None = None) -> occupancy_map.OccupancyMap:
    """The map of a map.yaml, for the floor ``floor``. The image's path is relative to the file.
    Raises MisuseError."""
    described = _described(path)
    image = path.parent / described.image
    try:
        pixels = decode_rgba(
            _content(image, MAX_IMAGE_BYTES),
            occupancy_map.MAX_MAP_SIDE,
            occupancy_map.MAX_MAP_CELLS,
        )
        cells = _cells(pixels, described)[::-1]
        about = path.stem, described.resolution, described.origin, path.name
        map_ = occupancy_map.OccupancyMap(*about, cells, floor)
        map_.encode()
    except BadImage as error:
        raise MisuseError(f"{image}: {error}; give a PGM or PNG image") from None
    except occupancy_map.InvalidMap as error:
        raise MisuseError(f"{path}: {error}") from None
    return map_


def _described(path: Path) -> _MapFile:
    text = _content(path, MAX_YAML_BYTES)
    try:
        document = parse_yaml(text)
    except user_files.FileFault as fault:
        raise MisuseError(f"{path}: no YAML: {fault}; give a map server's map.yaml") from None
    if not isinstance(document, dict):
        raise MisuseError(
            f"{path}: no map.yaml: it has no fields such as image and resolution, but is"
            f" {visible(abbreviate(document))}; give a map server's map.yaml"
        )
    try:
        described = _MapFile.model_validate(document)
    except ValidationError as error:
        raise MisuseError(f"{path}: {_fault(error, text)}") from None
    if described.free_thresh > described.occupied_thresh:
        raise MisuseError(
            f"{path}: free_thresh {described.free_thresh:g} is above occupied_thresh "
            f"{described.occupied_thresh:g}; lower the one or raise the other (often 0.25 and 0.65)"
        )
    return described


def _fault(error: ValidationError, text: bytes) -> str:
    """The first invalid field: the rule, its value and line, and what to write instead."""
    first = error.errors(include_url=False)[0]
    name = str(first["loc"][0])
    field = visible(".".join(map(str, first["loc"])))
    if first["type"] == "missing" and len(first["loc"]) == 1:
        return f"{field}: {describe_error(first)}; add {_ADVICE[name]}"
    value = first["input"]
    line = next((n for n, row in enumerate(text.splitlines(), 1) if _is_of(row, name)), None)
    where = "" if line is None else f" in line {line}"
    given = f"got {visible(abbreviate(value))}{where}"
    return f"{field}: {describe_error(first)} ({given}); give {_ADVICE[name]}"


def _is_of(row: bytes, name: str) -> bool:
    return row.split(b":", 1)[0].strip(b" \"'") == name.encode()


_ADVICE: Final = {
    "image": "the name of a PGM or PNG file",
    "resolution": "the side of a pixel in metres, such as 0.05",
    "origin": "[x, y, yaw] of the image's lower left corner, in metres and radians",
    "negate": "0, or 1 where white is occupied",
    "occupied_thresh": "a share from 0 to 1, such as 0.65",
    "free_thresh": "a share from 0 to 1, such as 0.25",
    "mode": "trinary, scale or raw",
}


def _content(path: Path, limit: int) -> bytes:
    try:
        return user_files.read_file(path, limit)
    except user_files.FileFault as fault:
        raise MisuseError(f"{visible(str(path))}: {fault}; check the path") from None


def parse_yaml(text: bytes) -> Any:
    """A YAML document by the rules of `base.user_files`. Aliases are refused, as a short text
    with them can be a document without end. Raises FileFault."""
    try:
        return yaml.load(text, _Loader)  # noqa: S506 - a SafeLoader
    except user_files.FileFault:
        raise
    except yaml.YAMLError as error:
        raise user_files.FileFault(visible(" ".join(str(error).split()))) from None
    except RecursionError:
        raise user_files.too_deep() from None
    except (ValueError, ArithmeticError, LookupError, AttributeError, TypeError) as error:
        # of PyYAML, for values that are not of the type of their tag
        raise user_files.FileFault(f"a value that is not of its type ({error})") from None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """A SafeLoader with the bounds of `eventsrc.base.user_files`."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            alias = self.peek_event()
            raise user_files.FileFault(
                f"line {alias.start_mark.line + 1}: an alias, *{visible(alias.anchor)[:40]}; "
                "write the value there instead"
            )
        self._depth += 1
        if self._depth > user_files.MAX_DEPTH:
            raise user_files.too_deep()
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_yaml_int(self, node: Any) -> int:
        return user_files.checked_int(super().construct_yaml_int(_short(node)), node.value)

    def construct_yaml_float(self, node: Any) -> float:
        return float(super().construct_yaml_float(_short(node)))


def _short(node: Any) -> Any:
    if isinstance(node.value, str) and len(node.value) > user_files.MAX_DIGITS:
        line = node.start_mark.line + 1
        raise user_files.FileFault(
            f"line {line}: a number of {len(node.value):,} characters, {visible(node.value[:20])}…"
        )
    return node


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
_Loader.add_constructor("tag:yaml.org,2002:float", _Loader.construct_yaml_float)


def _cells(pixels: NDArray[np.uint8], described: _MapFile) -> NDArray[np.uint8]:
    """The cells, shape (height, width), of pixels of red, green, blue and alpha."""
    total = pixels[..., :3].sum(axis=-1, dtype=np.uint16)
    table = _raw_values() if described.mode == "raw" else _threshold_values(described)
    cells: NDArray[np.uint8] = table[total]
    if described.mode != "raw":
        cells[pixels[..., 3] != _OPAQUE] = occupancy_map.UNKNOWN
    return cells


def _raw_values() -> NDArray[np.uint8]:
    """The cell of each sum of red, green and blue, 0 to 765."""
    level = np.rint(np.arange(_WHITE + 1) / 3)
    return np.where(level <= occupancy_map.OCCUPIED, level, occupancy_map.UNKNOWN).astype(np.uint8)


def _threshold_values(described: _MapFile) -> NDArray[np.uint8]:
    """The cell of each sum of red, green and blue, 0 to 765."""
    shade = np.arange(_WHITE + 1) / _WHITE
    occupied = shade if described.negate else 1.0 - shade
    low, high = described.free_thresh, described.occupied_thresh
    between = np.full(_WHITE + 1, float(occupancy_map.UNKNOWN))
    if described.mode == "scale" and high > low:
        between = np.rint((occupied - low) / (high - low) * 98.0 + 1.0).clip(1.0, 99.0)
    values = np.where(
        occupied > high, float(occupancy_map.OCCUPIED), np.where(occupied < low, 0.0, between)
    )
    return values.astype(np.uint8)


MAX_LABEL_BYTES: Final = 1_000_000
_WITHIN: Final = ("names", "class_names", "categories", "id2label", "labels")
_LABEL: Final = ("id", "class_id", "label_id")
_NAME: Final = ("name", "class_name", "label")


def read_labels(path: Path) -> dict[str, str]:
    """The names of a file by label; an empty name names nothing. Raises MisuseError."""
    place = f"--labels {path}"
    found = dict(_pairs(_document(path), place))
    if not found:
        raise MisuseError(f"{place}: names no class; write one a line")
    return found


def _document(path: Path) -> Any:
    place = f"--labels {path}"
    is_yaml = path.suffix.lower() in (".yaml", ".yml")
    try:
        content = read_file(path, MAX_LABEL_BYTES)
    except FileFault as fault:
        raise MisuseError(f"{place}: {fault}; give a file with the names of classes") from None
    try:
        if is_yaml:
            return parse_yaml(content)
        if not content.removeprefix(b"\xef\xbb\xbf").lstrip().startswith(b"{"):
            return read_label_file(path)
        return parse_json(content.decode("utf-8-sig"))
    except FileFault as fault:
        kind = "YAML" if is_yaml else "JSON"
        raise MisuseError(f"{place}: {fault}; give names by label as {kind}") from None
    except UnicodeDecodeError:
        raise MisuseError(f"{place}: no UTF-8 text; give a line for each class") from None


def _pairs(document: Any, place: str) -> Iterable[tuple[str, str]]:
    if isinstance(document, dict):
        for name in _WITHIN:
            if isinstance(document.get(name), dict | list):
                return _pairs(document[name], place)
        pairs = list(document.items())
    elif isinstance(document, list):
        pairs = [_pair(number, each) for number, each in enumerate(document)]
    else:
        raise MisuseError(f"{place}: not a list of names; write one a line")
    labels: dict[str, str] = {}
    for label, name in pairs:
        if isinstance(label, bool | float) or not isinstance(label, str | int):
            raise MisuseError(f"{place}: {_shown(label)} is no label; give a number or a text")
        if not isinstance(name, str):
            raise MisuseError(
                f"{place}: not a list of names: {_shown(name)} is the name of label {_shown(label)}"
            )
        if labels.setdefault(str(label), name) != name:
            raise MisuseError(f"{place}: label {_shown(label)} has two names; give one")
    return [(label, name) for label, name in labels.items() if label and name]


def _pair(number: int, item: Any) -> tuple[Any, Any]:
    """Label and name of an item of a list."""
    if not isinstance(item, dict):
        return number, item
    label, name = (
        next((item[key] for key in keys if key in item), None) for keys in (_LABEL, _NAME)
    )
    return label, name


def _shown(value: Any) -> str:
    return visible(abbreviate(value))
