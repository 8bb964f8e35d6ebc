"""Names of classes by label, of a file.

The label is what a detector writes as the class, often a number. A file of JSON, or of YAML where
its name ends so, is an object of names by label, a list of names from label 0 on, a list of objects
with the label and the name of a class, such as COCO's categories, or an object that has one of
these in ``names``, ``class_names``, ``categories``, ``id2label`` or ``labels``. Any other file has
a name in each line, the first that of label 0.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from eventsrc.base.errors import MisuseError
from eventsrc.base.text import visible
from eventsrc.base.user_files import FileFault, parse_json, read_file, read_label_file
from eventsrc.envelope.ingest import abbreviate

from .map_yaml import parse_yaml

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
