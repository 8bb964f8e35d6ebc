"""Files that a person names: read, with JSON or class names in them, and written.

Read: nothing blocks, and no content takes much. A file is a regular one (a FIFO blocks until
someone writes to it, a device may have no end) and of bounded size. Documents are of bounded depth,
and their whole numbers fit into a float: Python raises ValueError for the text of one of 5,000
digits, and OverflowError for its float. YAML is read in `eventsrc.record.importers.map_yaml` by the
same rules. Callers check the fields of a document.

Written: complete under its name, or not there. A file is written under another name in its folder
(``.NAME.1a2b3c4d.partial``), synced and renamed. Where writing fails or is interrupted, what had
the name keeps it and the other file is removed; only SIGKILL or a power cut leaves it. A pipe or a
device, such as ``/dev/stdout``, is written to as it is.
"""

import contextlib
import errno
import io
import json
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from io import BufferedReader, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from eventsrc.base.errors import MapfoldError, MisuseError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


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
        raise FileFault(f"larger than {max_bytes:,} bytes, too much for such a file")
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


_MOST_LABEL_BYTES: Final = 1_000_000
_NAME_IN_BRACKETS: Final = re.compile(r"\[[^]\",\n]+\][ \t\r]*(\n|$)")
"""A first line such as ``[background]``, which begins no JSON list."""


def read_label_file(path: Path, else_give: str = "check the path") -> list[Any]:
    """The class names in a file, one a line or as a JSON list, in order from that of class 0.

    Lines are stripped; all but the last may be empty. Items of a JSON list are returned unchecked.
    Raises MisuseError; for a file that cannot be read its message ends with ``else_give``.
    """
    place = f"--labels {path}"
    try:
        content = read_file(path, _MOST_LABEL_BYTES)
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


_NO_SPACE: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_MOST_OF_NAME: Final = 50
"""Characters of a name that its temporary one repeats: of 4 bytes each, they leave room for the
rest in the 255 bytes of a name."""


class OutputFile(io.FileIO):
    """A file for ``path``, opened under its temporary name; unbuffered. A failed write is a
    MapfoldError that names ``path``; only that of a closed pipe stays a BrokenPipeError."""

    def __init__(self, path: Path, temporary: Path, flags: int) -> None:
        super().__init__(os.open(temporary, os.O_WRONLY | flags, 0o666), "w")
        self._path = path

    def write(self, data: "ReadableBuffer", /) -> int:
        """Write all of ``data``, in as many calls as the system needs."""
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left:
                written = super().write(left)
                if written is None:
                    raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))
                left = left[written:]
        except BrokenPipeError:
            raise
        except OSError as error:
            raise _failure(self._path, error) from None
        return size


@contextlib.contextmanager
def written_whole(path: Path) -> Iterator[OutputFile]:
    """A file that is named ``path`` when the block ends without an exception; makes its folder.

    Raises MisuseError where no file can be made there, MapfoldError where writing it fails.
    """
    final = Path(os.path.realpath(path))  # so that a symbolic link stays one
    name = f".{final.name[:_MOST_OF_NAME]}.{secrets.token_hex(4)}.partial"
    temporary = final.with_name(name)
    try:
        in_place = _is_written_in_place(path)
        final.parent.mkdir(parents=True, exist_ok=True)
        if in_place:
            file = OutputFile(path, path, 0)
        else:
            mode = _mode_of_replaced(final)
            file = OutputFile(path, temporary, os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW)
    except OSError as error:
        if error.errno in _NO_SPACE:
            raise _failure(path, error) from None
        raise MisuseError(f"{path}: cannot be written: {error.strerror}; choose another") from None
    if in_place:
        with file:
            yield file
        return
    try:
        with file:
            yield file
            with _failing_as(path):
                if mode is not None:
                    os.fchmod(file.fileno(), mode)
                os.fsync(file.fileno())
        with _failing_as(path):
            temporary.replace(final)
    finally:
        temporary.unlink(missing_ok=True)


def write_files(contents: Mapping[Path, bytes]) -> None:
    """Write several files; none gets its name before all are written.

    Raises MisuseError and MapfoldError as `written_whole` does.
    """
    with contextlib.ExitStack() as stack:
        for path, content in contents.items():
            stack.enter_context(written_whole(path)).write(content)


def _is_written_in_place(path: Path) -> bool:
    """Whether it is no regular file; what /proc and /dev/stdout lead to may be one, but is open."""
    folder = path.parent.resolve()
    if folder == Path("/dev") or folder.is_relative_to("/proc"):
        return True
    return path.exists() and not path.is_file() and not path.is_dir()


def _mode_of_replaced(final: Path) -> int | None:
    """Permissions of the file that has the name; None if there is none. Raises OSError where it is
    a folder or may not be written."""
    if not final.exists():
        return None
    if final.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(final, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return final.stat().st_mode & 0o777


@contextlib.contextmanager
def _failing_as(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise _failure(path, error) from None


def _failure(path: Path, error: OSError) -> MapfoldError:
    next_step = "free space there" if error.errno in _NO_SPACE else "choose another place"
    return MapfoldError(
        f"{path}: could not be written: {error.strerror}; a file that was there before is"
        f" unchanged; {next_step} and run this again"
    )
