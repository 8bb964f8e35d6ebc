"""Files that a person names, and JSON in them: nothing blocks, and no content takes much.

A file is a regular one (a FIFO blocks until someone writes to it, a device may have no end) and of
bounded size. Documents are of bounded depth, and their whole numbers fit into a float: Python
raises ValueError for the text of one of 5,000 digits, and OverflowError for its float. YAML is read
in `eventsrc.record.importers.map_yaml` by the same rules. Callers check the fields of a document.
"""

import json
import os
import stat
from io import BufferedReader, FileIO
from pathlib import Path
from typing import Any, Final

MAX_DEPTH: Final = 100
"""Bound of lists and objects in one another."""
_MAX_INT: Final = 2**1023
MAX_DIGITS: Final = 400
"""Digits of a whole number that are read at all; `_MAX_INT` has 308."""


class FileFault(ValueError):
    """The file or document is not read. The text is the reason, without the file's name."""


def open_file(path: Path) -> BufferedReader:
    """Open a regular file for reading. Raises FileFault."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise FileFault(error.strerror or str(error)) from None
    except ValueError as error:  # a name with a null character
        raise FileFault(str(error)) from None
    mode = os.fstat(fd).st_mode
    if not stat.S_ISREG(mode):
        os.close(fd)
        raise FileFault("Is a directory" if stat.S_ISDIR(mode) else "not a regular file")
    return BufferedReader(FileIO(fd))


def read_file(path: Path, max_bytes: int) -> bytes:
    """The bytes of a regular file. Raises FileFault, also for more than ``max_bytes``."""
    try:
        with open_file(path) as file:
            content = file.read(max_bytes + 1)
    except OSError as error:
        raise FileFault(error.strerror or str(error)) from None
    if len(content) > max_bytes:
        raise FileFault(f"larger than {max_bytes:,} bytes; is this the right file?")
    return content


def parse_json(text: bytes | str) -> Any:
    """A JSON document. Raises FileFault."""
    try:
        document = json.loads(text, parse_int=_parsed_int)
    except RecursionError:
        raise too_deep() from None
    except FileFault:
        raise
    except ValueError as error:
        raise FileFault(str(error)) from error
    _check_depth(document)
    return document


def _parsed_int(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise FileFault(f"a number of {len(digits):,} digits, {digits[:20]}…")
    return checked_int(int(digits), digits)


def checked_int(value: int, text: str) -> int:
    """``value``, which ``text`` says. Raises FileFault if no float is as large."""
    if abs(value) >= _MAX_INT:
        raise FileFault(f"a number that is too large, {text[:20]}…")
    return value


def _check_depth(document: Any) -> None:
    """Raise FileFault for more than `MAX_DEPTH` levels. Each level is looked through at once."""
    level = [document]
    for _ in range(MAX_DEPTH + 1):
        inner: list[Any] = []
        for each in level:
            if isinstance(each, dict):
                inner += each.values()
            elif isinstance(each, list):
                inner += each
        level = inner
        if not level:
            return
    raise too_deep()


def too_deep() -> FileFault:
    """The fault of a document of more than `MAX_DEPTH` levels."""
    return FileFault(f"lists and objects of more than {MAX_DEPTH} levels")
