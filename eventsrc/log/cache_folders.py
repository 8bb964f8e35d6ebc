"""The folder of caches beside a log: ``<log>.history``.

It is not part of the log and safe to delete at any time. It holds the log's data, so its
permissions are at most those of the log.
"""

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO, Final

from eventsrc.base.clock import system_clock

_OWNER: Final = 0o700
_OTHERS: Final = 0o077
_UNFINISHED: Final = ".new"
_LEFT_OVER_S: Final = 3_600.0


def cache_folder(log: Path) -> Path:
    """The path of the folder, which may not exist. For a log given as ``.`` or ``..`` it is
    beside the folder that these name."""
    named = log.resolve() if log.name in ("", "..") else log
    return named.parent / f"{named.name}.history"


def make_cache_folder(log: Path) -> Path:
    """Create `cache_folder` if it does not exist, with no more permissions for group and others
    than the log has; return its path. Raises OSError."""
    folder = cache_folder(log)
    folder.mkdir(mode=_OWNER | (log.stat().st_mode & _OTHERS), exist_ok=True)
    return folder


def write_cache_file(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file under another name and rename it, so that other threads and processes see all
    of it or nothing. Raises OSError and what ``write`` raises; then nothing is left behind."""
    beside = path.with_name(f"{path.name}.{os.getpid()}.{threading.get_ident()}{_UNFINISHED}")
    try:
        beside.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW
        with os.fdopen(os.open(beside, flags, 0o644), "wb") as file:
            write(file)
        beside.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)
        raise


def delete_left_over_files(folder: Path) -> None:
    """Delete what killed processes have left of `write_cache_file`. Raises OSError."""
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process did
            age_s = system_clock() / 1e9 - path.lstat().st_mtime
            if path.name.endswith(_UNFINISHED) and age_s > _LEFT_OVER_S:
                path.unlink()


def cache_sizes(log: Path) -> list[tuple[Path, int]]:
    """The folder with the total size of its files in bytes, if it exists and can be read."""
    folder = cache_folder(log)
    with contextlib.suppress(OSError):
        return [(folder, sum(map(_size, folder.iterdir())))]
    return []


def _size(path: Path) -> int:
    with contextlib.suppress(FileNotFoundError):  # another process replaced it
        return path.lstat().st_size
    return 0
