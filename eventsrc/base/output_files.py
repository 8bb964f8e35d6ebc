"""Files written for a user: complete under their names, or not there.

A file is written under another name in its folder (``.NAME.1a2b3c4d.partial``), synced and renamed.
Where writing fails or is interrupted, what had the name keeps it and the other file is removed;
only SIGKILL or a power cut leaves it. A pipe or a device, such as ``/dev/stdout``, is written to as
it is.
"""

import contextlib
import errno
import io
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from eventsrc.base.errors import MapfoldError, MisuseError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

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
