"""Import messages from files into a log."""

from .run import (
    DEFAULT_KEY,
    IMPORT_FSYNC,
    ImportInterrupted,
    ImportReport,
    check_sources,
    import_files,
)

__all__ = [
    "DEFAULT_KEY",
    "IMPORT_FSYNC",
    "ImportInterrupted",
    "ImportReport",
    "check_sources",
    "import_files",
]
