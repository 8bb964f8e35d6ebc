"""Getting messages that others kept into a log."""

from .run import DEFAULT_KEY, LAZY_COMMIT, ImportCut, ImportReport, check_sources, import_files

__all__ = [
    "DEFAULT_KEY",
    "LAZY_COMMIT",
    "ImportCut",
    "ImportReport",
    "check_sources",
    "import_files",
]
