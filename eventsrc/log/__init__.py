"""The log: an append-only directory of MCAP segments, the only truth (docs/log-format.md)."""

from .event import Event
from .fsync import ALWAYS, GROUP_COMMIT, NEVER, FsyncPolicy, parse_fsync
from .info import LogInfo, SegmentInfo, log_info
from .reader import LogReader
from .tail import follow
from .writer import LogWriter

__all__ = [
    "ALWAYS",
    "GROUP_COMMIT",
    "NEVER",
    "Event",
    "FsyncPolicy",
    "LogInfo",
    "LogReader",
    "LogWriter",
    "SegmentInfo",
    "follow",
    "log_info",
    "parse_fsync",
]
