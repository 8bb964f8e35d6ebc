"""The folders of caches beside a log: ``<log>.history`` and ``<log>.snapshots``.

They are not part of the log and safe to delete at any time. They hold the log's data, so their
permissions are at most those of the log.
"""

import contextlib
from pathlib import Path
from typing import Final, Literal, get_args

CacheKind = Literal["history", "snapshots"]
_KINDS: Final[tuple[CacheKind, ...]] = get_args(CacheKind)
_OWNER: Final = 0o700
_OTHERS: Final = 0o077


def cache_folder(log: Path, kind: CacheKind) -> Path:
    """The path of a cache folder, which may not exist. For a log given as ``.`` or ``..`` it is
    beside the folder that these name."""
    named = log.resolve() if log.name in ("", "..") else log
    return named.parent / f"{named.name}.{kind}"


def make_cache_folder(log: Path, kind: CacheKind) -> Path:
    """Create `cache_folder` if it does not exist, with no more permissions for group and others
    than the log has; return its path. Raises OSError."""
    folder = cache_folder(log, kind)
    folder.mkdir(mode=_OWNER | (log.stat().st_mode & _OTHERS), exist_ok=True)
    return folder


def cache_sizes(log: Path) -> list[tuple[Path, int]]:
    """Each cache folder that exists and can be read, with the total size of its files in bytes."""
    sizes = []
    for kind in _KINDS:
        folder = cache_folder(log, kind)
        with contextlib.suppress(OSError):
            sizes.append((folder, sum(map(_size, folder.iterdir()))))
    return sizes


def _size(path: Path) -> int:
    with contextlib.suppress(FileNotFoundError):  # another process replaced it
        return path.lstat().st_size
    return 0
