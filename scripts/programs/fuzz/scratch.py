"""A folder in memory for targets that read files; gone with the process."""

import tempfile
from functools import cache
from pathlib import Path

from tests.support.fixtures_log import MEMORY_DISK


@cache
def _folder() -> "tempfile.TemporaryDirectory[str]":
    base = MEMORY_DISK if MEMORY_DISK.is_dir() else None
    return tempfile.TemporaryDirectory(prefix="mapfold-fuzz-", dir=base)


def scratch() -> Path:
    """The folder."""
    return Path(_folder().name)
