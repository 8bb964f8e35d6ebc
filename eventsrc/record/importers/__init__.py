"""Import messages from files into a log."""

from .bag_streams import BagOptions
from .ros_bags import BagReport
from .run import (
    DEFAULT_KEY,
    IMPORT_FSYNC,
    ImportInterrupted,
    ImportReport,
    check_sources,
    import_files,
)
from .sources import TopicChoice

__all__ = [
    "DEFAULT_KEY",
    "IMPORT_FSYNC",
    "BagOptions",
    "BagReport",
    "ImportInterrupted",
    "ImportReport",
    "TopicChoice",
    "check_sources",
    "import_files",
]
