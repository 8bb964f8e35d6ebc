"""Read files of class names, one a line or as a JSON list. The first name is that of class 0."""

import re
from pathlib import Path
from typing import Any, Final

from .errors import MisuseError
from .user_files import FileFault, parse_json, read_file

_MOST_BYTES: Final = 1_000_000
_NAME_IN_BRACKETS: Final = re.compile(r"\[[^]\",\n]+\][ \t\r]*(\n|$)")
"""A first line such as ``[background]``, which begins no JSON list."""


def read_label_file(path: Path, else_give: str = "check the path") -> list[Any]:
    """The class names in a file, in order.

    Lines are stripped; all but the last may be empty. Items of a JSON list are returned unchecked.
    Raises MisuseError; for a file that cannot be read its message ends with ``else_give``.
    """
    place = f"--labels {path}"
    try:
        content = read_file(path, _MOST_BYTES)
    except FileFault as fault:
        raise MisuseError(f"{place}: {fault}; {else_give}") from None
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise MisuseError(f"{place}: no UTF-8 text; give a line for each class") from None
    if text.lstrip().startswith("[") and not _NAME_IN_BRACKETS.match(text.lstrip()):
        try:
            names: list[Any] = parse_json(text)
        except FileFault as fault:
            raise MisuseError(f"{place}: no JSON list: {fault}") from None
        return names
    lines = [line.strip() for line in text.splitlines()]
    while lines and not lines[-1]:
        lines.pop()
    return lines
